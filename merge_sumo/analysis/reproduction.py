"""Reproduction of the paper: Table II and the figures, with our numbers and the paper's.

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
from merge_sumo.analysis.surface import nodes
from merge_sumo.analysis.truth import TRUTH_CASES
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.fmc import fmc
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import to_plain
from merge_sumo.result import Result
from merge_sumo.samplers.gpr import predicted_margin
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import FloatArray, Pool, to_unit
from merge_sumo.scenario.scenario import LEVELS, US23
from merge_sumo.simulation.plan import versions
from merge_sumo.workers import Workers

PAPER_SAMPLERS = ("uniform", "annealing", "subset", "gpr", "coverage")
ADAPTIVE = ("gpr", "coverage")
"""The paper's sampler and ours: their shares of the truth and of the levels are shown."""
SURFACE_BATCHES = (1, 4, 13, 20)
"""Numbers of batches after which the paper shows its surrogate."""
SURFACE_POINTS = 81
"""Number of points of a surrogate's grid along each coordinate."""


@dataclass(frozen=True, slots=True)
class Column:
    """A column of Table II: a VUT against one POV level, and the numbers of the paper.

    Attributes:
        vut: spec of the VUT.
        level: level of the POV.
        paper: the paper's FMC of the truth and of each of its samplers, by name.
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
    _paper = dict(zip(("truth", *PAPER_SAMPLERS[:4]), _fmc, strict=True))
    TABLE_II.append(Column(_vut, _level, _paper))


@dataclass(frozen=True, kw_only=True, slots=True)
class Scale:
    """The numbers of cases and seeds, by default those of the paper.

    Attributes:
        seeds: number of searches of each sampler.
        truth_cases: number of uniform cases of the truth at levels 0, 1 and 2.
        batches: number of batches of every search, k.
        batch: number of cases of a batch at one level, n; doubled where all levels run.
    """

    seeds: int = 10
    truth_cases: tuple[int, int, int] = (TRUTH_CASES[0], TRUTH_CASES[1], TRUTH_CASES[2])
    batches: int = 20
    batch: int = 20


QUICK = Scale(seeds=2, truth_cases=(1000, 1000, 1000), batches=4, batch=15)
"""The scale of a first look and of tests, too small for results."""


def scale_of(options: config.Reproduce) -> Scale:
    """Return the scale of the options.

    Args:
        options: options of the verb.

    Raises:
        UserError: for no seeds.
    """
    check_least(options, seeds=1)
    scale = QUICK if options.quick else Scale()
    return scale if options.seeds is None else replace(scale, seeds=options.seeds)


@dataclass(frozen=True, slots=True)
class Panel:
    """Cases at one level.

    Attributes:
        points: the cases in the unit cube, (n, d).
        failed: whether each failed, (n,).
    """

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
        margin: predicted margins on a regular grid, (n, n), rows along v_POV0, columns along
            x_POV0.
        learned: the cases from which the surrogate has learned, in the unit square, (m, 2).
    """

    margin: FloatArray
    learned: FloatArray


@dataclass(frozen=True, slots=True)
class LevelBatches:
    """The batches of a sampler by level.

    Attributes:
        cases: number of cases of each batch, (seeds, batches).
        margin: their mean margin, NaN where no case has one, (seeds, batches).
    """

    cases: Mapping[int, FloatArray]
    margin: Mapping[int, FloatArray]


@dataclass(frozen=True)
class ColumnResult:
    """A column with our results.

    Attributes:
        column: the column.
        study: the samplers in comparison, at the level of the column.
    """

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
        """Return the predictions of the surrogate of `gpr`, of one search, by number of batches."""
        searches, level = self.study.searches["gpr"], self.column.level
        seed = _median_seed(searches)
        points = nodes((SURFACE_POINTS, SURFACE_POINTS, 1))
        result = {}
        for batch in SURFACE_BATCHES:
            if batch <= len(searches[seed].fmc):
                known = [outcome for outcome in searches[seed].outcomes if outcome.batch < batch]
                sampler = make_sampler("gpr", Pool(levels=(level,), scenario=US23), seed)
                sampler.tell(known)
                margin = predicted_margin(sampler.history(level), points)
                square = margin.reshape(SURFACE_POINTS, SURFACE_POINTS)
                result[batch] = PredictedMargins(square, _panel(known, level).points)
        return result


@dataclass(frozen=True, repr=False)
class Reproduction(Result):
    """The results of the paper next to the results of merge-sumo.

    `ms.reproduce` returns it.

    Example:
        ```python
        found = ms.reproduce(quick=True, out="reproduction")
        print(found)
        ```

    Attributes:
        scale: numbers of cases and seeds.
        columns: columns of Table II of the paper, by title.
        levels: batches of searches at all levels together, by sampler.
        policies_sha256: hashes of the networks of the POV, by name.
        versions: versions of the software, by name.
        page: page with the results; None if it was not written.
    """

    scale: Scale
    columns: dict[str, ColumnResult]
    levels: dict[str, LevelBatches]
    policies_sha256: dict[str, str]
    versions: dict[str, str] = field(default_factory=versions)
    page: Path | None = None

    def to_record(self) -> dict[str, Any]:
        """Return the object that `--json` prints: Table II."""
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
        policies: folder of the POV networks; None for the shipped ones.
        workers: where cases run; None for this process.
        on_part: called with the progress of each part.

    Returns:
        The results, without a page.

    Raises:
        UserError: where a level has no POV.
    """
    folder = None if policies is None else str(policies)
    studies = {}
    for vut in ("design1", "design2"):
        settings = CampaignSettings(vut=vut, levels=LEVELS, scenario=US23, policies=folder)
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
        found = studies[column.vut].compare((column.level,), PAPER_SAMPLERS, options)
        columns[column.title] = ColumnResult(column, found)
    batch = 2 * scale.batch
    options = config.Benchmark(
        "design2", seeds=scale.seeds, cases=scale.batches * batch, batch=batch
    )
    together = studies["design2"].searches(LEVELS, ADAPTIVE, options)
    levels = {name: _level_batches(searches) for name, searches in together.items()}
    return Reproduction(scale, columns, levels, studies["design2"].plan.povs.sha256())


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
        sums, known = np.zeros_like(cases[level]), np.zeros_like(cases[level])
        for seed, search in enumerate(searches):
            for outcome in search.outcomes:
                if outcome.case.level == level:
                    cases[level][seed, outcome.batch] += 1
                    known[seed, outcome.batch] += outcome.margin is not None
                    sums[seed, outcome.batch] += outcome.margin or 0.0
        margin[level] = sums / np.where(known > 0, known, np.nan)
    return LevelBatches(cases, margin)
