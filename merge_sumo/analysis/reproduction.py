"""The paper's results in one go: what Table II and the figures show, our numbers and the paper's.

Every number is the median over seeds; a picture of single cases shows the seed whose coverage is
the median. Same seeds and same versions give the same files.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo import config
from merge_sumo.analysis.run_study import OnPart, check_least
from merge_sumo.analysis.sampler_study import SamplerRun, SamplerStudy, Study
from merge_sumo.analysis.truth import TRUTH_CASES
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.drivers.policies import policies_of
from merge_sumo.metrics.fmc import fmc
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import to_plain
from merge_sumo.result import Result
from merge_sumo.samplers.gpr import predicted_margin
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import FloatArray, Pool, to_unit
from merge_sumo.scenario.scenario import LEVELS, US23
from merge_sumo.simulation.plan import versions
from merge_sumo.simulation.povs import Povs
from merge_sumo.workers import Workers

SAMPLERS = ("uniform", "annealing", "subset", "gpr", "coverage")
ADAPTIVE = ("gpr", "coverage")
"""The paper's sampler and ours: whose shares of the truth and of the levels are shown."""
SURFACE_BATCHES = (1, 4, 13, 20)
"""Batches after which the paper shows its surrogate."""
SURFACE_POINTS = 81
"""Points of a surrogate's grid, in each direction."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of Table II: a VUT against one POV level, and what the paper found.

    Attributes:
        paper: FMC of the truth and of each sampler that the paper has.
    """

    vut: str
    level: int
    paper: Mapping[str, float]

    @property
    def title(self) -> str:
        """What stands above the column."""
        return f"level-{self.level} POV, {self.vut}"


PAPERS = ("truth", "uniform", "annealing", "subset", "gpr")
TABLE_II = tuple(
    Column(vut, level, dict(zip(PAPERS, found, strict=True)))
    for vut, level, found in (
        ("design1", 0, (0.1296, 0.0223, 0.0497, 0.0830, 0.1012)),
        ("design2", 1, (0.0849, 0.0144, 0.0184, 0.0445, 0.0585)),
        ("design2", 2, (0.0073, 0.0, 0.0006, 0.0019, 0.0032)),
    )
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Scale:
    """How much is run. The default is the paper's.

    Attributes:
        seeds: runs of each sampler.
        truth_cases: uniform cases of the truth at each level.
        batches: k, the batches of every run.
        batch: n, the cases per batch at one level; twice as many run where all levels do.
    """

    seeds: int = 10
    truth_cases: tuple[int, int, int] = (TRUTH_CASES[0], TRUTH_CASES[1], TRUTH_CASES[2])
    batches: int = 20
    batch: int = 20


def quick(seeds: int) -> Scale:
    """Return a scale for a first look and for tests: it shows that all works, and no more."""
    return Scale(seeds=seeds, truth_cases=(1000, 1000, 1000), batches=4, batch=15)


def scale_of(asked: config.Reproduce) -> Scale:
    """Return the scale of the options; `UserError` for numbers that make none."""
    check_least(asked, seeds=1)
    if asked.quick:
        return quick(2 if asked.seeds is None else asked.seeds)
    return Scale() if asked.seeds is None else Scale(seeds=asked.seeds)


@dataclass(frozen=True, slots=True)
class Panel:
    """Cases at one level in the unit cube, (n, d), which of them failed, (n,), and their FMC."""

    points: FloatArray
    failed: NDArray[np.bool_]
    fmc: float


@dataclass(frozen=True, slots=True)
class PredictedMargins:
    """What a surrogate predicts after a number of batches.

    Attributes:
        margin: on a regular grid, (n, n), rows along v_POV0, columns along x_POV0.
        learned: the cases that it has learned from.
    """

    margin: FloatArray
    learned: Panel


@dataclass(frozen=True, slots=True)
class LevelBatches:
    """How a sampler went on over batches at each level, one row per seed, (seeds, batches).

    Attributes:
        cases: cases at the level in each batch.
        margin: mean margin of them; NaN where there was none.
    """

    cases: Mapping[int, FloatArray]
    margin: Mapping[int, FloatArray]


@dataclass(frozen=True)
class ColumnResult:
    """A column that has run, and the study of its samplers at its level."""

    column: Column
    study: SamplerStudy

    @cached_property
    def panels(self) -> dict[str, Panel]:
        """Cases of the truth, and of each sampler with the seed whose coverage is its median."""
        level = self.column.level
        truth, searches = self.study.truths[level], reversed(self.study.searches.items())
        shown = Panel(truth.points, truth.margin < 0.0, fmc(truth.failures))
        found = {name: of_name[_median_seed(of_name)].outcomes for name, of_name in searches}
        return {"truth": shown, **{name: _panel(one, level) for name, one in found.items()}}

    def predicted(self) -> dict[int, PredictedMargins]:
        """Return what the surrogate of `gpr` predicts after some batches of its median search."""
        searches, level = self.study.searches["gpr"], self.column.level
        seed = _median_seed(searches)
        axis = np.linspace(0.0, 1.0, SURFACE_POINTS)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
        result = {}
        for batch in (b for b in SURFACE_BATCHES if b <= len(searches[seed].fmc)):
            known = [outcome for outcome in searches[seed].outcomes if outcome.batch < batch]
            sampler = make_sampler("gpr", Pool(levels=(level,), scenario=US23), seed)
            sampler.tell(known)
            margin = predicted_margin(sampler.history(level), grid)
            square = margin.reshape(SURFACE_POINTS, SURFACE_POINTS)
            result[batch] = PredictedMargins(square, _panel(known, level))
        return result


@dataclass(frozen=True, repr=False)
class Reproduction(Result):
    """What ran.

    Attributes:
        scale: how much of it.
        columns: those of Table II, by title.
        levels: all levels together, by sampler.
        policies_sha256: the POVs.
        versions: the software.
        page: the page that shows it, if it was written.
    """

    scale: Scale
    columns: dict[str, ColumnResult]
    levels: dict[str, LevelBatches]
    policies_sha256: dict[str, str]
    versions: dict[str, str] = field(default_factory=versions)
    page: Path | None = None

    def to_record(self) -> dict[str, Any]:
        """Return Table II for a program."""
        return {
            "scale": to_plain(self.scale),
            "versions": self.versions,
            "policies_sha256": self.policies_sha256,
            "columns": [
                {**to_plain(one.column), **one.study.to_record()} for one in self.columns.values()
            ],
        }


def reproduce(
    scale: Scale,
    *,
    policies: Path | None = None,
    workers: Workers | None = None,
    on_part: OnPart = lambda *_: None,
) -> Reproduction:
    """Run what Table II and the figures need.

    The POVs are those of `policies`, by default the shipped ones; `on_part` is told how far it is.
    Raises `UserError` where a level has no POV.

    Args:
        scale: numbers of cases and seeds.
        policies: folder of the POV networks; by default the shipped ones.
        workers: where cases run; by default this process.
        on_part: called with the title of a part, its cases that are done, and all.
    """
    povs = Povs(policies=policies or policies_of(US23))

    def study(vut: str) -> Study:
        folder = str(povs.policies)
        settings = CampaignSettings(vut=vut, levels=(0,), scenario=US23, policies=folder)
        return Study(resolve(settings), workers, on_part=on_part)

    for level in LEVELS:
        povs.check_level(level)
    columns = {}
    for column in TABLE_II:
        # In batches of Table II's size; those of `coverage` are a part of it.
        asked = config.Benchmark(
            column.vut,
            seeds=scale.seeds,
            cases=scale.batches * scale.batch,
            truth_cases=scale.truth_cases[column.level],
        )
        found = study(column.vut).compare((column.level,), SAMPLERS, asked)
        columns[column.title] = ColumnResult(column, found)
    batch = 2 * scale.batch
    together = study("design2").searches(
        LEVELS, ADAPTIVE, scale.seeds, scale.batches * batch, batch
    )
    levels = {name: _level_batches(of_name) for name, of_name in together.items()}
    return Reproduction(scale, columns, levels, povs.sha256())


def _median_seed(searches: Sequence[SamplerRun]) -> int:
    """Return the seed whose coverage is the median, the lower one of two."""
    order = sorted(range(len(searches)), key=lambda seed: (searches[seed].fmc[-1], seed))
    return order[(len(order) - 1) // 2]


def _panel(outcomes: Sequence[Outcome], level: int) -> Panel:
    points = to_unit((outcome.case for outcome in outcomes), level, US23)
    failed = np.array([outcome.failed for outcome in outcomes])
    return Panel(points, failed, fmc(points[failed]))


def _level_batches(searches: Sequence[SamplerRun]) -> LevelBatches:
    shape = len(LEVELS), len(searches), len(searches[0].fmc)
    cases, judged, total = np.zeros((3, *shape))
    for seed, one in enumerate(searches):
        for outcome in one.outcomes:
            place = LEVELS.index(outcome.case.level), seed, outcome.batch
            cases[place] += 1
            if outcome.margin is not None:
                judged[place] += 1
                total[place] += outcome.margin
    margin = np.divide(total, judged, out=np.full(shape, np.nan), where=judged > 0)
    return LevelBatches(
        dict(zip(LEVELS, cases, strict=True)), dict(zip(LEVELS, margin, strict=True))
    )
