"""How likely a VUT is to fail under a stated distribution over the pool, with an interval.

A sampler chose the cases of a campaign because they were expected to fail, given those before. No
share of them is the probability of a failure, and no binomial interval of theirs is valid. So they
only shape the mixture from which fresh cases are drawn independently; the estimate rests on these
(`importance.py`).
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.analysis.exposure import Distribution, read_distribution
from merge_sumo.campaigns.campaign import OnCase
from merge_sumo.campaigns.settings import CampaignSettings, record_of
from merge_sumo.campaigns.store import Run
from merge_sumo.engine.evaluate import evaluate, open_simulators, workers_or_here
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.studies.importance import (
    DEFENSIVE,
    DefensiveMixture,
    Draws,
    Estimate,
    cells,
    estimate,
    expected_chance,
)
from merge_sumo.system.folders import add_to, check_new_file, write_new
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case
from merge_sumo.values.score import Outcome

RESULT: Final = "probability.json"
LINES: Final = ".jsonl"
"""End of the name of the file beside it, with a line per fresh case."""
DEFAULT_CASES: Final = 4000
STREAM: Final = 7
"""Key of the random stream, so that it is none of a sampler's."""
WRITTEN: Final = 500
"""Cases after which outcomes are written and synced."""


def failure_probability(
    run: Run,
    settings: CampaignSettings,
    plan: SimulationPlan,
    out: Path,
    *,
    cases: int = DEFAULT_CASES,
    distribution: Path | None = None,
    confidence: float = 0.95,
    seed: int = 0,
    workers: Workers | None = None,
    on_case: OnCase | None = None,
) -> Estimate:
    """Estimate how likely the VUT of a campaign is to fail, with fresh cases.

    Writes the estimate with all that decides it to `out`, and the fresh outcomes, each with its
    weight, to the file of the same name that ends in .jsonl, synced every few hundred cases.

    Args:
        run: the campaign.
        settings: those of the campaign, except for policies that are elsewhere and how a VUT is
            hosted.
        plan: that of the settings.
        out: new file, which ends in .json.
        cases: fresh cases.
        distribution: JSON file that states how often cases occur; uniform over the pool without.
        confidence: chance that the interval holds the probability.
        seed: of the draws.
        workers: where cases run, by default in this process; the estimate is the same.
        on_case: told each fresh outcome.

    Raises:
        UserError: for a distribution or numbers that make no sense, a run whose net or policies are
            not those of today, or files that exist or cannot be written.
    """
    for name, number, fits, bounds in (
        ("cases", cases, cases >= 1, "it must be 1 or more"),
        ("confidence", confidence, 0.5 <= confidence < 1.0, "choose 0.5 or more, and below 1"),
        ("seed", seed, seed >= 0, "it must be 0 or more"),
    ):
        if not fits:
            raise UserError(f"--{name} is {number}: {bounds}")
    _same_system(run, record_of(settings, plan))
    stated = read_distribution(distribution, settings.levels, settings.scenario)
    check_new_file(out)
    lines = out.with_suffix(LINES)
    if lines == out:
        raise UserError(f"--out is {out}: end it in .json, as cases go to {LINES} beside it")
    check_new_file(lines)
    mixture = _mixture(run, settings, stated)
    draws = mixture.draw(cases, np.random.default_rng([seed, STREAM]))
    outcomes = _run(settings, plan, stated, draws, lines, on_case, workers)
    failed = np.array([outcome.failed for outcome in outcomes])
    judged = np.array([outcome.score is not None for outcome in outcomes])
    result = estimate(draws, failed, judged, mixture.bound, confidence)
    record = {
        **asdict(result),
        "distribution": stated.record(),
        "defensive_share": DEFENSIVE,
        "seed": seed,
        "engine": plan.engine,
        "campaign": record_of(settings, plan),
    }
    write_new(out, (json.dumps(record, indent=2, allow_nan=False) + "\n").encode())
    return result


def _mixture(run: Run, settings: CampaignSettings, stated: Distribution) -> DefensiveMixture:
    """Return the mixture that the outcomes of a campaign suggest."""
    sampler = make_sampler("uniform", settings.pool, 0)
    sampler.tell(run.outcomes)
    chance = {}
    for level in stated.levels:
        history = sampler.history(level)
        chance[level] = expected_chance(history, stated.points(level, cells(history.dims)))
    return DefensiveMixture(stated.levels, chance, settings.scenario)


def _same_system(run: Run, today: Mapping[str, Any]) -> None:
    for name in ("net_sha256", "policies_sha256"):
        if run.settings.get(name) != today[name]:
            what, others = ("net", "another") if name == "net_sha256" else ("policies", "other")
            raise UserError(
                f"{run.folder} was run with {others} {what}: name what it was run with, --{what}"
            )


def _run(
    settings: CampaignSettings,
    plan: SimulationPlan,
    stated: Distribution,
    draws: Draws,
    lines: Path,
    on_case: OnCase | None,
    workers: Workers | None,
) -> list[Outcome]:
    """Run the draws in order, some at a time; write each outcome with its weight."""
    by_place: dict[int, Case] = {}
    for level in stated.levels:
        places = np.flatnonzero(draws.level == level)
        dims = len(settings.scenario.dimensions(level))
        points = stated.points(level, draws.chances[places, :dims])
        drawn = settings.pool.cases(points, level)
        by_place.update(zip(places.tolist(), drawn, strict=True))
    cases = [by_place[place] for place in range(len(by_place))]
    outcomes: list[Outcome] = []
    with workers_or_here(workers) as processes:
        plan = plan.for_cases(len(cases))
        open_simulators(plan, processes)
        for first in range(0, len(cases), WRITTEN):
            ran = []
            for place, done in evaluate(plan, cases[first : first + WRITTEN], processes):
                outcome = done.outcome(first + place, first // WRITTEN)
                ran.append(outcome)
                if on_case is not None:
                    on_case(outcome)
            ran.sort(key=lambda outcome: outcome.index)
            _append(lines, ran, draws)
            outcomes += ran
    return outcomes


def _append(lines: Path, outcomes: Sequence[Outcome], draws: Draws) -> None:
    content = ""
    for o in outcomes:
        record = o.to_record()
        record["weight"] = float(draws.weight[o.index])
        record["plain"] = bool(draws.plain[o.index])
        content += json.dumps(record, allow_nan=False) + "\n"
    add_to(lines, content.encode(), new=outcomes[0].index == 0)
