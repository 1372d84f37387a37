"""Repair: values of a controller's parameters with which the failures of a campaign pass.

A trial is a set of values. The failures of the campaign, its near misses and a share of its other
cases run with it. optuna proposes the trials of a search with several objectives: the cases that
still fail, the extra cost, and the change of the values; what breaks a case that passed is a
constraint. Of the trials that break nothing the choice is, in this order:

1. the fewest cases that fail;
2. the least extra cost, in steps of `COST_STEP`: nothing where the cost is that of today or less;
3. the smallest change: the sum over the parameters of the change as a share of the range.

The chosen values are then taken back towards those of today, parameter by parameter, as far as
the choice stays as good, and all cases of the campaign must pass that passed before. A fresh
campaign, which learns from nothing, tests the result. Its failures, with cases around them, join
those of the next round of the search. The round with the least FMC in its fresh campaign counts.

trials.jsonl            in the folder of a repair: one line per trial, in their order, synced
campaign-1/             the fresh campaign of the first round
repair.json             the result
repair.html             its page, and changes.html that of the comparison with today's values
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib.util import find_spec
from operator import attrgetter, itemgetter
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from msgspec import field

from merge_sumo import config
from merge_sumo.campaigns.again import campaign_in
from merge_sumo.campaigns.run import Run, spread_failures
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.coverage.fmc import RADIUS
from merge_sumo.engine.evaluate import evaluate
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, from_unit, to_unit
from merge_sumo.studies.comparison import Comparison, compare_episodes, cut, passes
from merge_sumo.studies.run_study import OnPart, RunStudy, check_least
from merge_sumo.system.folders import add_to, make_folder
from merge_sumo.system.printable import counted
from merge_sumo.system.records import Record, to_json, to_plain
from merge_sumo.system.result import Result
from merge_sumo.verdict.episode import Episode
from merge_sumo.verdict.score import Outcome
from merge_sumo.verdict.summary import summarise
from merge_sumo.vuts.factory import VutFactory
from merge_sumo.vuts.parameters import Range
from merge_sumo.vuts.spec import parse

if TYPE_CHECKING:
    import optuna

TRIALS: Final = "trials.jsonl"
CAMPAIGN: Final = "campaign-{}"
SHARE: Final = 0.2
"""Share of the passing cases, besides near misses, that run in each trial."""
COST_STEP: Final = 0.1
"""Extra costs are compared in steps of 0.1 s, or of 0.1 m/s2. Chosen, not tuned."""
BISECTIONS: Final = 4
"""Steps by which a value is taken back towards that of today."""
RESERVE: Final = 0.25
"""Where a value cannot be taken back to that of today it goes on so far, as a share of its
change: between the cases that ran are others. Chosen, not tuned."""
NEIGHBOURS: Final = 10
"""Cases that each failure of a fresh campaign brings to the next round besides itself. Chosen, not
tuned: without any, four failures of design2 moved a threshold by 1 %, just past these four."""
LISTED: Final = 30
"""Indices of cases that a line names, at most."""
MOST_AGAINST: Final = 40
"""Failures of a fresh campaign that join the next round: the worst of each region, the second of
each, and so on."""
CONFIRMED: Final = 5
"""Most trials that run all cases, the best first."""


class Cost(StrEnum):
    """Cost of a repair."""

    TIME = "time"
    BRAKING = "braking"


MEASURED_BY: Final = {Cost.TIME: ("t_end_s", "s"), Cost.BRAKING: ("vut_max_brake_mps2", "m/s2")}
"""The measure of a cost, whose mean over the cases is compared, and its unit."""


class Trial(Record, frozen=True):
    """Values, and what became of the cases with them.

    Cases are named by their index in the campaign; those of fresh campaigns have later numbers.

    Attributes:
        round: round of the search, from 1.
        values: the values by parameter.
        fails: cases that do not pass now, of those that did not with today's values.
        broke: cases that passed with today's values and do not pass now.
        extra: by cost, its mean over the cases minus that with today's values.
        differs: whether any case ended otherwise than with today's values.
        refused: why the controller does not take the values; empty where it does.
    """

    round: int
    values: dict[str, float]
    fails: tuple[int, ...] = ()
    broke: tuple[int, ...] = ()
    extra: dict[str, float] = field(default_factory=dict)
    differs: bool = True
    refused: str = ""

    @property
    def holds(self) -> bool:
        """Whether it was run and broke nothing."""
        return not self.refused and not self.broke

    def aims(self, cost: str) -> tuple[int, int]:
        """Return what is compared before the change: failures, and steps of extra cost."""
        return len(self.fails), math.ceil(round(self.costs_more(cost) / COST_STEP, 9))

    def costs_more(self, cost: str) -> float:
        """Return the extra cost, 0 where it costs no more than today."""
        return max(self.extra.get(cost, 0.0), 0.0)


@dataclass(frozen=True, slots=True)
class Round:
    """A round with values that help.

    Attributes:
        chosen: the trial with these values, of all cases.
        campaign: the fresh campaign.
        compared: what its cases are with today's values, and with the chosen ones.
    """

    chosen: Trial
    campaign: Run
    compared: Comparison

    @property
    def failing(self) -> tuple[int, int]:
        """Number of the fresh cases that do not pass: with today's values, with the chosen ones."""
        cases = self.compared.steps[0].cases
        return sum(not passes(c.a) for c in cases), sum(not passes(c.b) for c in cases)

    @property
    def fmc(self) -> float:
        """FMC of the failures of the fresh campaign, summed over the levels."""
        levels = summarise(self.campaign.cases, self.campaign.levels).levels
        return sum(one.fmc for one in levels.values())

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        return {
            "values": self.chosen.values,
            "extra": self.chosen.extra,
            "campaign": str(self.campaign.folder),
            "cases": len(self.campaign.outcomes),
            "failures": sum(not passes(outcome) for outcome in self.campaign.outcomes),
            "fmc": self.fmc,
            "broke": self.compared.broke,
        }


@dataclass(frozen=True, slots=True, repr=False)
class RepairResult(Result):
    """Values of a controller's parameters that repair it, or that there are none.

    Attributes:
        folder: folder of the repair.
        vut: the controller as it is, a spec.
        ranges: the parameters that may change.
        today: their values today.
        cost: what was kept low.
        seed: of the search.
        cases: number of cases of the campaign.
        failing: indices of its cases that do not pass with today's values.
        rounds: the rounds with values that help.
        trials: all trials, in their order.
    """

    folder: Path
    vut: str
    ranges: tuple[Range, ...]
    today: Mapping[str, float]
    cost: str
    seed: int
    cases: int
    failing: tuple[int, ...]
    rounds: tuple[Round, ...]
    trials: tuple[Trial, ...]

    @property
    def best(self) -> Round | None:
        """The round that counts: its fresh campaign has the least FMC; None where no values help.

        Of equal ones it is the later, which more cases have tried.
        """
        return min(reversed(self.rounds), key=attrgetter("fmc"), default=None)

    @property
    def chosen(self) -> Trial | None:
        """The trial with the chosen values; None where no values help."""
        return None if self.best is None else self.best.chosen

    @property
    def repaired(self) -> str | None:
        """The repaired controller as a spec; None where no fresh campaign confirms values."""
        if self.chosen is None or not self.verified:
            return None
        return str(parse(self.vut).with_values(self.chosen.values, self.today))

    @property
    def campaign_again(self) -> str:
        """The command of a campaign of the repaired controller; empty where there is none."""
        if self.repaired is None or self.best is None:
            return ""
        return campaign_in(self.best.campaign.scenario, vut=self.repaired)

    @property
    def stays(self) -> tuple[int, ...]:
        """Indices of the cases of the campaign that still do not pass."""
        if self.chosen is None:
            return self.failing
        return tuple(index for index in self.chosen.fails if index < self.cases)

    @property
    def verified(self) -> bool:
        """Whether values were found, and no case of the fresh campaign broke by them."""
        return self.best is not None and not self.best.compared.worse

    @property
    def unverified(self) -> str:
        """What speaks against the chosen values, in a sentence; empty where no values help."""
        if self.best is None:
            return ""
        compared, (today, now) = self.best.compared, self.best.failing
        return (
            f"Not verified: of the {counted(len(compared.steps[0].cases), 'case')} of a fresh "
            f"campaign {today} do not pass with today's values, and {now} with the values tried; "
            f"{compared.broke} broke. These values are no repair."
        )

    def to_record(self) -> dict[str, Any]:
        """Return what `repair.json` holds, and `--json` prints."""
        names = ("vut", "ranges", "today", "cost", "seed", "cases", "failing", "repaired")
        record = {name: getattr(self, name) for name in (*names, "verified", "stays")}
        rounds = [one.to_record() for one in self.rounds]
        return {"folder": str(self.folder), **to_plain(record), "rounds": rounds}

    def lines(self) -> list[str]:
        """Return the values, what they cost, what a fresh campaign says, and the command."""
        failing = f"{counted(len(self.failing), 'case')} of {self.cases}"
        stays = f"still failing{cut(len(self.stays), LISTED)}: "
        stays += ", ".join(map(str, self.stays[:LISTED]))
        if self.chosen is None:
            none = f"{self.vut}: {failing} fail, and no values in these ranges let one pass without"
            return [f"{none} others that fail", f"  these stay, {stays}"]
        passing = len(self.failing) - len(self.stays)
        lines = [
            *([] if self.verified else [self.unverified]),
            f"{self.vut}: {failing} did not pass; with other values {passing} of them pass, and "
            "none that passed fails",
            *([f"  {stays}"] if self.stays else []),
        ]
        for name, value in self.chosen.values.items():
            changed = "" if value == self.today[name] else f" -> {value:g}"
            lines.append(f"  {name}: {self.today[name]:g}{changed}")
        extra = self.chosen.extra
        costs = (f"{extra[cost]:+.2f} {unit} of {cost}" for cost, (_, unit) in MEASURED_BY.items())
        return [
            *lines,
            f"  cost, mean of a case: {', '.join(costs)}",
            *(
                f"fresh campaign {number}, {counted(len(one.campaign.outcomes), 'case')}: with "
                f"today's values and the new ones {one.compared.headline}"
                for number, one in enumerate(self.rounds, start=1)
            ),
            *([f"the repaired controller: {self.campaign_again}"] if self.campaign_again else []),
        ]


def ranges_of(asked: config.Repair) -> tuple[Range, ...]:
    """Return the parameters that may change, with their ranges.

    Raises `UserError` for values that make no search, and where optuna is not installed.
    """
    if find_spec("optuna") is None:
        raise UserError("repair needs optuna: run `pip install 'merge-sumo[repair]'`")
    if asked.cost not in list(Cost):
        raise UserError(f"`cost` is {asked.cost!r}: choose {' or '.join(Cost)}")
    ranges = tuple(map(Range.parsed, asked.params))
    if not ranges:
        raise UserError("name what may change: `params` NAME=LOW..HIGH")
    # Today's values and both ends of each range are tried.
    check_least(asked, rounds=1, cases=1, seed=0, trials=1 + 2 * len(ranges))
    return ranges


def fresh_settings(
    today: CampaignSettings, before: Run, asked: config.Repair, spec: str, number: int
) -> CampaignSettings:
    """Return the settings of the fresh campaign of a round: another seed, and no earlier lesson.

    `today` are those of the campaign `before`.
    """
    cases = len(before.outcomes) if asked.cases is None else asked.cases
    few: dict[str, Any] = {
        name: None if (known := getattr(today, name)) is None or known > cases else known
        for name in ("batch", "in_flight")
    }
    repeat = today.repeat if isinstance(today.repeat, str) else min(today.repeat, cases)
    seed = today.seed + asked.seed + number
    changes = {"vut": spec, "seed": seed, "cases": cases, "repeat": repeat, **few}
    return replace(today, stop_when_converged=False, **changes)


def repair(
    study: RunStudy,
    asked: config.Repair,
    folder: Path,
    fresh: Callable[[str, int], Run],
    on_part: OnPart = lambda *_: None,
) -> RepairResult:
    """Search for values that repair the controller of a campaign, round by round.

    Args:
        study: the campaign, and how its cases run.
        asked: what is searched for.
        folder: new folder for what is found.
        fresh: runs the fresh campaign of a spec in a round.
        on_part: told how far the trials of a round are.

    Raises:
        UserError: for values that make no search, where no case fails, and for a parameter without
            an effect.
    """
    search = _Repair(study, asked, folder, on_part)
    rounds: list[Round] = []
    for number in range(1, asked.rounds + 1):
        chosen = search.round(number, rounds[-1].chosen if rounds else None)
        if chosen is None:
            break
        campaign = fresh(str(study.plan.vut.spec.with_values(chosen.values, search.today)), number)
        rounds.append(Round(chosen, campaign, search.compared(campaign)))
        untested = [outcome for outcome in campaign.outcomes if not outcome.is_tested]
        against = [*spread_failures(campaign.outcomes), *untested][:MOST_AGAINST]
        if not against:
            break
        rng = np.random.default_rng([asked.seed, number, 1])
        search.cases += with_neighbours([outcome.case for outcome in against], rng)
    return RepairResult(
        folder=folder,
        vut=str(study.plan.vut.spec),
        ranges=search.ranges,
        today=search.today,
        cost=asked.cost,
        seed=asked.seed,
        cases=len(study.run.outcomes),
        failing=search.failing,
        rounds=tuple(rounds),
        trials=tuple(search.trials),
    )


class _Repair:
    """The search for values, with its cases and its trials."""

    def __init__(
        self, study: RunStudy, asked: config.Repair, folder: Path, on_part: OnPart
    ) -> None:
        self._plan, self._workers, self._folder = study.plan, study.workers, folder
        self._asked, self._on_part, self.ranges = asked, on_part, ranges_of(asked)
        self.today = study.plan.vut.values_of(self.ranges)
        self.cases = [outcome.case for outcome in study.run.outcomes]
        self.failing: tuple[int, ...] = ()
        self.trials: list[Trial] = []
        self._before: list[Outcome] = []
        """Outcomes of the cases with today's values."""
        self._round = 1

    def compared(self, campaign: Run) -> Comparison:
        """Compare a fresh campaign with today's values in the same cases."""
        cases = [outcome.case for outcome in campaign.outcomes]
        today = dict(evaluate(self._plan.for_cases(len(cases)), cases, self._workers))
        before = [today[one.index].at(one.index, one.batch) for one in campaign.outcomes]
        return compare_episodes(before, campaign, str(self._plan.vut.spec))

    def round(self, number: int, earlier: Trial | None) -> Trial | None:
        """Search in a round; return the best trial, with all cases, or None where none helps."""
        self._round = number
        self._before += self._run(self._plan, self.cases[len(self._before) :])
        if earlier is None:
            self.failing = tuple(i for i, old in enumerate(self._before) if not passes(old))
            if not self.failing:
                raise UserError(
                    f"every case passes with {self._plan.vut.spec}: nothing is to be repaired"
                )
            make_folder(self._folder)
        selected = self._selected()
        found = self._proposed(selected, earlier)
        trials = (trial for trial in found if trial.holds)
        better = sorted(trials, key=lambda t: (*t.aims(self._asked.cost), self._change(t)))
        for trial in better[:CONFIRMED]:
            if len(trial.fails) >= len(found[0].fails):
                return None
            trimmed = self._trimmed(trial, selected)
            everywhere = self._trial(trimmed.values, range(len(self.cases)))
            if everywhere.holds:
                return everywhere
        return None

    def _change(self, trial: Trial) -> float:
        """Return the sum over the parameters of the change as a share of the range."""
        return sum(self._share(trial, one) for one in self.ranges)

    def _share(self, trial: Trial, one: Range) -> float:
        return abs(trial.values[one.name] - self.today[one.name]) / (one.high - one.low)

    def _run(self, plan: SimulationPlan, cases: Sequence[Case]) -> list[Outcome]:
        ran = evaluate(plan.for_cases(len(cases)), cases, self._workers, _outcome_of)
        return [outcome for _, outcome in sorted(ran, key=itemgetter(0))]

    def _selected(self) -> list[int]:
        """Return the cases of a trial: what does not pass, near misses, and a share of the rest."""
        failing = [i for i, before in enumerate(self._before) if not passes(before)]
        passing = [i for i, before in enumerate(self._before) if passes(before)]
        passing.sort(key=lambda i: (self._before[i].margin or 0.0, i))
        near, rest = passing[: len(failing)], passing[len(failing) :]
        rng = np.random.default_rng([self._asked.seed, self._round])
        drawn = rng.choice(len(rest), math.ceil(SHARE * len(rest)), replace=False)
        return sorted({*failing, *near, *(rest[k] for k in drawn.tolist())})

    def _proposed(self, selected: Sequence[int], earlier: Trial | None) -> list[Trial]:
        """Run the trials that optuna proposes: first today's values, and both ends of each range.

        A later round begins with today's values, and with those that the earlier one has chosen.
        Raises `UserError` for a parameter of which both ends change nothing.
        """
        import optuna

        ends = [(one, end) for one in self.ranges for end in (one.low, one.high)]
        others = [{**self.today, one.name: end} for one, end in ends]
        first = [self.today, *(others if earlier is None else [earlier.values])]
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        # Startup trials are drawn at random: a few for each parameter.
        startup = max(10, len(first) + 4 * len(self.ranges))
        seed = self._asked.seed * 1000 + self._round
        sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=startup, multivariate=True)
        study = optuna.create_study(directions=["minimize"] * 3, sampler=sampler)
        for values in first:
            study.enqueue_trial(dict(values))
        found = [self._next(study, selected) for _ in range(self._asked.trials)]
        of_ends = zip(ends, found[1:], strict=False) if earlier is None else ()
        effect = {one.name for (one, _), trial in of_ends if trial.differs or trial.refused}
        for one in self.ranges if earlier is None else ():
            if one.name not in effect:
                raise UserError(
                    f"`params` {one.name} has no effect on any case, be it {one.low:g} or "
                    f"{one.high:g}: leave it out, or name what the controller reads"
                )
        return found

    def _next(self, study: optuna.Study, selected: Sequence[int]) -> Trial:
        """Ask for a trial, run it and tell what became of it."""
        import optuna

        floats = optuna.distributions.FloatDistribution
        asked = study.ask({one.name: floats(one.low, one.high) for one in self.ranges})
        values = {one.name: one.rounded(asked.params[one.name]) for one in self.ranges}
        # Today's values have all their digits.
        is_todays = all(asked.params[name] == value for name, value in self.today.items())
        trial = self._trial(self.today if is_todays else values, selected)
        if trial.refused:
            study.tell(asked, state=optuna.trial.TrialState.FAIL)
            return trial
        asked.set_constraint("broke", float(len(trial.broke)))
        more = trial.costs_more(self._asked.cost)
        study.tell(asked, [len(trial.fails), more, self._change(trial)])
        return trial

    def _trial(self, values: Mapping[str, float], indices: Sequence[int]) -> Trial:
        """Run a trial on cases and record it."""
        trial = self._ran(dict(values), indices)
        add_to(self._folder / TRIALS, to_json(trial), new=not self.trials)
        self.trials.append(trial)
        # How many the search for the smallest change takes is not known before.
        done = sum(one.round == self._round for one in self.trials)
        total = max(done, self._asked.trials)
        self._on_part(f"round {self._round}", done, total, "trials", "")
        return trial

    def _ran(self, values: dict[str, float], indices: Sequence[int]) -> Trial:
        old = [self._before[index] for index in indices]
        try:
            if values == self.today:
                new = old
            else:
                spec = self._plan.vut.spec.with_values(values, self.today)
                vut = VutFactory(spec, self._plan.vut.options)
                cases = [self.cases[index] for index in indices]
                new = self._run(replace(self._plan, vut=vut), cases)
        except UserError as error:
            return Trial(self._round, values, refused=str(error))
        both = [(a, b) for a, b in zip(old, new, strict=True) if a.is_tested and b.is_tested]
        extra = {}
        for cost, (name, _) in MEASURED_BY.items():
            means = [[float(one.measures.value(name) or 0.0) for one in pair] for pair in both]
            extra[cost.value] = fmean(b - a for a, b in means) if both else 0.0
        wrong = [(i, passes(a)) for i, a, b in zip(indices, old, new, strict=True) if not passes(b)]
        return Trial(
            self._round,
            values,
            fails=tuple(index for index, passed in wrong if not passed),
            broke=tuple(index for index, passed in wrong if passed),
            extra=extra,
            differs=any(a.measures != b.measures for a, b in zip(old, new, strict=True)),
        )

    def _trimmed(self, best: Trial, selected: Sequence[int]) -> Trial:
        """Return a trial with values as near to today's as the choice allows, with a reserve."""
        aims, kept = best.aims(self._asked.cost), best

        def as_good(name: str, value: float) -> bool:
            nonlocal kept
            trial = self._trial({**kept.values, name: value}, selected)
            good = trial.holds and trial.aims(self._asked.cost) <= aims
            kept = trial if good else kept
            return good

        for one in sorted(self.ranges, key=lambda r: -self._share(best, r)):
            bad, good = self.today[one.name], kept.values[one.name]
            if good == bad or as_good(one.name, bad):
                continue
            today = bad
            for _ in range(BISECTIONS):
                middle = (bad + good) / 2.0
                if as_good(one.name, one.rounded(middle)):
                    good = middle
                else:
                    bad = middle
            as_good(one.name, one.rounded(good + RESERVE * (good - today)))
        return kept


def with_neighbours(cases: Sequence[Case], rng: np.random.Generator) -> list[Case]:
    """Return cases, and around each others within the radius of FMC on every axis of the pool.

    A failure is one of a region: values that let it pass alone repair nothing.
    """
    found = list(cases)
    for case in cases:
        centre = to_unit([case], case.level, case.scenario)
        offsets = rng.uniform(-RADIUS, RADIUS, (NEIGHBOURS, centre.shape[1]))
        near = np.clip(centre + offsets, 0.0, 1.0)
        found += from_unit(near, case.level, scenario=case.scenario)
    return found


def _outcome_of(episode: Episode) -> Outcome:
    return episode.outcome
