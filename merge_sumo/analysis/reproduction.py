"""The paper's results: Table II and the figures, with our numbers and the paper's.

Every number is the median over seeds; a picture of single cases is of the seed with the median.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from merge_sumo import config
from merge_sumo.analysis.run_study import OnPart, check_least
from merge_sumo.analysis.sampler_study import SamplerRun, SamplerStudy, Study
from merge_sumo.analysis.truth import TRUTH_CASES
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
"""The paper's sampler and ours, of which shares of the truth and of the levels are shown."""
SURFACE_BATCHES = (1, 4, 13, 20)
"""Batches after which the paper shows its surrogate."""
SURFACE_POINTS = 81
"""Points of a surrogate's grid, in each direction."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of Table II: a VUT against one POV level, and the numbers of the paper.

    Attributes:
        paper: FMC of the truth and of each sampler that the paper has.
    """

    vut: str
    level: int
    paper: Mapping[str, float]

    @property
    def title(self) -> str:
        """The title of the column."""
        return f"level-{self.level} POV, {self.vut}"


TABLE_II = []
for _vut, _level, *_fmc in (
    ("design1", 0, 0.1296, 0.0223, 0.0497, 0.0830, 0.1012),
    ("design2", 1, 0.0849, 0.0144, 0.0184, 0.0445, 0.0585),
    ("design2", 2, 0.0073, 0.0, 0.0006, 0.0019, 0.0032),
):
    _paper = dict(zip(("truth", *SAMPLERS[:4]), _fmc, strict=True))
    TABLE_II.append(Column(_vut, _level, _paper))


@dataclass(frozen=True, kw_only=True, slots=True)
class Scale:
    """The numbers of cases and seeds, by default those of the paper.

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


QUICK = Scale(seeds=2, truth_cases=(1000, 1000, 1000), batches=4, batch=15)
"""The scale of a first look and of tests: it shows that all works, and no more."""


def scale_of(options: config.Reproduce) -> Scale:
    """Return the scale of the options; `UserError` for no seeds."""
    check_least(options, seeds=1)
    scale = QUICK if options.quick else Scale()
    return scale if options.seeds is None else replace(scale, seeds=options.seeds)


@dataclass(frozen=True, slots=True)
class Panel:
    """Cases at one level in the unit cube, (n, d), and which of them failed, (n,)."""

    points: FloatArray
    failed: NDArray[np.bool_]

    @property
    def fmc(self) -> float:
        """Their failure mode coverage."""
        return fmc(self.points[self.failed])


@dataclass(frozen=True, slots=True)
class PredictedMargins:
    """The predictions of a surrogate after a number of batches.

    Attributes:
        margin: on a regular grid, (n, n), rows along v_POV0, columns along x_POV0.
        learned: the cases that it has learned from.
    """

    margin: FloatArray
    learned: Panel


@dataclass(frozen=True, slots=True)
class LevelBatches:
    """The batches of a sampler at each level, one row per seed, (seeds, batches).

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
        truth = self.study.truths[self.column.level]
        panels = {"truth": Panel(truth.points, truth.margin < 0.0)}
        for name, searches in reversed(self.study.searches.items()):
            panels[name] = _panel(searches[_median_seed(searches)].outcomes, self.column.level)
        return panels

    def predicted(self) -> dict[int, PredictedMargins]:
        """Return the predictions of the surrogate of `gpr` after some batches, of one search."""
        searches, level = self.study.searches["gpr"], self.column.level
        seed = _median_seed(searches)
        axis = np.linspace(0.0, 1.0, SURFACE_POINTS)
        grid = np.stack(np.meshgrid(axis, axis), axis=-1)
        result = {}
        for batch in SURFACE_BATCHES:
            if batch <= len(searches[seed].fmc):
                known = [outcome for outcome in searches[seed].outcomes if outcome.batch < batch]
                sampler = make_sampler("gpr", Pool(levels=(level,), scenario=US23), seed)
                sampler.tell(known)
                margin = predicted_margin(sampler.history(level), grid.reshape(-1, 2))
                square = margin.reshape(grid.shape[:2])
                result[batch] = PredictedMargins(square, _panel(known, level))
        return result


@dataclass(frozen=True, repr=False)
class Reproduction(Result):
    """The results of the paper, and ours.

    Attributes:
        scale: the numbers of cases and seeds.
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
        columns = []
        for one in self.columns.values():
            columns.append({**to_plain(one.column), **one.study.to_record()})
        return {
            "scale": to_plain(self.scale),
            "versions": self.versions,
            "policies_sha256": self.policies_sha256,
            "columns": columns,
        }


def reproduce(
    scale: Scale,
    *,
    policies: Path | None = None,
    workers: Workers | None = None,
    on_part: OnPart = lambda *_: None,
) -> Reproduction:
    """Run the searches and truths of Table II and the figures.

    Args:
        scale: numbers of cases and seeds.
        policies: folder of the POV networks; by default the shipped ones.
        workers: where cases run; by default this process.
        on_part: called with the progress of each part.

    Raises:
        UserError: where a level has no POV.
    """
    povs = Povs(policies=policies or policies_of(US23))
    for level in LEVELS:
        povs.check_level(level)
    studies = {}
    for vut in ("design1", "design2"):
        folder = str(povs.policies)
        settings = CampaignSettings(vut=vut, levels=(0,), scenario=US23, policies=folder)
        studies[vut] = Study(settings.load_plan(), workers or Workers(), on_part=on_part)
    columns = {}
    for column in TABLE_II:
        # In batches of Table II's size; those of `coverage` are a part of it.
        options = config.Benchmark(
            column.vut,
            seeds=scale.seeds,
            cases=scale.batches * scale.batch,
            truth_cases=scale.truth_cases[column.level],
        )
        found = studies[column.vut].compare((column.level,), SAMPLERS, options)
        columns[column.title] = ColumnResult(column, found)
    batch = 2 * scale.batch
    options = config.Benchmark(
        "design2", seeds=scale.seeds, cases=scale.batches * batch, batch=batch
    )
    together = studies["design2"].searches(LEVELS, ADAPTIVE, options)
    levels = {name: _level_batches(searches) for name, searches in together.items()}
    return Reproduction(scale, columns, levels, povs.sha256())


def _median_seed(searches: Sequence[SamplerRun]) -> int:
    """Return the seed whose coverage is the median, the lower one of two."""
    order = sorted(range(len(searches)), key=lambda seed: (searches[seed].fmc[-1], seed))
    return order[(len(order) - 1) // 2]


def _panel(outcomes: Sequence[Outcome], level: int) -> Panel:
    points = to_unit((outcome.case for outcome in outcomes), level, US23)
    return Panel(points, np.array([outcome.failed for outcome in outcomes]))


def _level_batches(searches: Sequence[SamplerRun]) -> LevelBatches:
    cases, margin = {}, {}
    for level in LEVELS:
        cases[level] = np.zeros((len(searches), len(searches[0].fmc)))
        margin[level] = np.full_like(cases[level], np.nan)
        for seed, search in enumerate(searches):
            at_level = [outcome for outcome in search.outcomes if outcome.case.level == level]
            for batch in range(len(search.fmc)):
                margins = [outcome.margin for outcome in at_level if outcome.batch == batch]
                cases[level][seed, batch] = len(margins)
                known = [one for one in margins if one is not None]
                if known:
                    margin[level][seed, batch] = np.mean(known)
    return LevelBatches(cases, margin)
