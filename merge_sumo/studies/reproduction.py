"""The paper's results in one go: what Table II and the figures show, our numbers and the paper's.

Every number is the median over seeds; a picture of single cases shows the seed whose coverage is
the median. Same seeds and same versions give the same files:

reproduction.json       all that the page and its figures are drawn from, after each column
table2.json, table2.md  Table II, for a program and to read
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final, get_args

import msgspec
import numpy as np
from numpy.typing import NDArray

from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.drivers.policies import policies_of
from merge_sumo.engine.plan import versions
from merge_sumo.engine.povs import Povs
from merge_sumo.errors import UserError
from merge_sumo.samplers.gpr import predicted_score
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.studies.sampler_study import OnPart, SamplerStudy, SamplerSummary, Search, Study
from merge_sumo.studies.truth import TRUTH_CASES
from merge_sumo.system.arrays import regular
from merge_sumo.system.folders import make_folder, replace_own, write_new
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import FloatArray, Pool, to_unit
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import LEVELS, US23
from merge_sumo.values.score import FAILURE_SCORE, Outcome

REPRODUCTION: Final = "reproduction.json"
TABLE_JSON: Final = "table2.json"
TABLE_MARKDOWN: Final = "table2.md"
SAMPLERS: Final = ("uniform", "annealing", "subset", "gpr", "coverage")
ADAPTIVE: Final = ("gpr", "coverage")
"""The paper's sampler and ours: whose shares of the truth and of the levels are shown."""
SURFACE_BATCHES: Final = (1, 4, 13, 20)
"""Batches after which the paper shows its surrogate."""
SURFACE_POINTS: Final = 81
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


TABLE_II: Final = (
    Column(
        "design1",
        0,
        {"truth": 0.1296, "uniform": 0.0223, "annealing": 0.0497, "subset": 0.0830, "gpr": 0.1012},
    ),
    Column(
        "design2",
        1,
        {"truth": 0.0849, "uniform": 0.0144, "annealing": 0.0184, "subset": 0.0445, "gpr": 0.0585},
    ),
    Column(
        "design2",
        2,
        {"truth": 0.0073, "uniform": 0.0, "annealing": 0.0006, "subset": 0.0019, "gpr": 0.0032},
    ),
)


@dataclass(frozen=True, kw_only=True, slots=True)
class Scale:
    """How much is run. The default is the paper's; `UserError` for numbers that make none.

    Attributes:
        seeds: runs of each sampler.
        truth_cases: uniform cases of the truth at each level.
        batches: k, the batches of every run.
        batch: n, the cases per batch at one level; twice as many run where all levels do.
        dense: whether to run a dense truth, or to go without; None for one that is kept.
    """

    seeds: int = 10
    truth_cases: tuple[int, int, int] = (TRUTH_CASES[0], TRUTH_CASES[1], TRUTH_CASES[2])
    batches: int = 20
    batch: int = 20
    dense: bool | None = None

    def __post_init__(self) -> None:
        if self.seeds < 1:
            raise UserError(f"--seeds is {self.seeds}: it must be 1 or more")


def quick(seeds: int) -> Scale:
    """Return a scale for a first look and for tests: it shows that all works, and no more."""
    return Scale(seeds=seeds, truth_cases=(1000, 1000, 1000), batches=4, batch=15, dense=False)


@dataclass(frozen=True, slots=True)
class Panel:
    """Cases at one level in the unit cube, (n, d), which of them failed, (n,), and their FMC."""

    points: FloatArray
    failed: NDArray[np.bool_]
    fmc: float


@dataclass(frozen=True, slots=True)
class PredictedScores:
    """What a surrogate predicts after a number of batches.

    Attributes:
        score: P on a regular grid, (n, n), rows along v_POV0, columns along x_POV0.
        learned: the cases that it has learned from.
    """

    score: FloatArray
    learned: Panel


@dataclass(frozen=True, slots=True)
class LevelBatches:
    """How a sampler went on over batches at each level, one row per seed, (seeds, batches).

    Attributes:
        cases: cases at the level in each batch.
        score: mean score P of them; NaN where there was none.
    """

    cases: Mapping[int, FloatArray]
    score: Mapping[int, FloatArray]


@dataclass(frozen=True, slots=True)
class ColumnResult:
    """A column that has run: what the truth holds, and each sampler beside it.

    Attributes:
        column: the column.
        truth_fmc: FMC of the truth.
        truth_failures: failures of the truth.
        truth_regions: its regions with a real share of them; None where it is too small for them.
        truth_remarks: for what it is too small, in clauses.
        dense_fmc: FMC of a dense truth, if there is one.
        limit_fmc: coverage of all that is known to fail.
        compared: each sampler over all seeds.
        oracle: FMC of the oracle after numbers of cases.
        panels: cases of the truth, and of each sampler with the seed whose coverage is its median.
        predicted: what the surrogate of `gpr` predicts after some batches; at level 1.
    """

    column: Column
    truth_fmc: float
    truth_failures: int
    truth_regions: int | None
    truth_remarks: list[str]
    dense_fmc: float | None
    limit_fmc: float
    compared: dict[str, SamplerSummary]
    oracle: dict[int, float] = field(default_factory=dict)
    panels: dict[str, Panel] = field(default_factory=dict)
    predicted: dict[int, PredictedScores] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Reproduction:
    """What ran: the scale, the columns by title, all levels together by sampler, the versions."""

    scale: Scale
    columns: dict[str, ColumnResult]
    levels: dict[str, LevelBatches]
    versions: dict[str, str]


def reproduce(
    folder: Path,
    scale: Scale,
    *,
    policies: Path | None = None,
    workers: Workers | None = None,
    on_part: OnPart = lambda *_: None,
) -> Reproduction:
    """Run what Table II and the figures need, and write it into a new folder.

    `reproduction.json` is written after each column. The POVs are those of `policies`, by default
    the shipped ones; `on_part` is told how far it is. Raises `UserError` when the folder exists or
    cannot be written, or where a level has no POV.
    """
    povs = Povs(policies=policies or policies_of(US23))
    for level in LEVELS:
        povs.check_level(level)
    make_folder(folder)

    def study(vut: str) -> Study:
        folder = str(povs.policies)
        settings = CampaignSettings(vut=vut, levels=(0,), scenario=US23, policies=folder)
        return Study(resolve(settings), workers, on_part=on_part)

    result = Reproduction(scale, {}, {}, versions())
    for column in TABLE_II:
        result.columns[column.title] = _column(column, scale, study(column.vut))
        _write(folder, result)
    batch = 2 * scale.batch
    together = study("design2").searches(
        LEVELS, ADAPTIVE, scale.seeds, scale.batches * batch, batch
    )
    result.levels.update({name: _level_batches(of_name) for name, of_name in together.items()})
    _write(folder, result)
    record = {**table_record(result), "policies_sha256": povs.sha256()}
    write_new(folder / TABLE_JSON, (json.dumps(record, allow_nan=False) + "\n").encode())
    write_new(folder / TABLE_MARKDOWN, table_markdown(result.columns).encode())
    return result


def _column(column: Column, scale: Scale, study: Study) -> ColumnResult:
    """Run one column of the table."""
    level, cases = column.level, scale.batches * scale.batch
    truth = study.truth(level, scale.truth_cases[level])
    dense = study.dense_truths((level,), scale.dense)
    # In batches of Table II's size; those of `coverage` are a part of it.
    searches = study.searches((level,), SAMPLERS, scale.seeds, cases, None)
    found = SamplerStudy.of(searches, {level: truth}, dense, cases, scale.batch)
    seeds = {name: _median_seed(of_name) for name, of_name in searches.items()}
    medians = {name: searches[name][seed].outcomes for name, seed in seeds.items()}
    panels = {name: _panel(medians[name], level) for name in reversed(SAMPLERS)}
    shown = Panel(truth.points, truth.score < FAILURE_SCORE, fmc(truth.failures))
    return ColumnResult(
        column=column,
        truth_fmc=found.truth_fmc,
        truth_failures=len(truth.failures),
        truth_regions=len(truth.real_regions()) if truth.tells_regions else None,
        truth_remarks=truth.remarks(),
        dense_fmc=fmc(dense[level].failures) if dense else None,
        limit_fmc=found.limit_fmc,
        compared=found.samplers,
        oracle=found.oracle_fmc,
        panels={"truth": shown, **panels},
        predicted=_predicted(medians["gpr"], seeds["gpr"], scale) if level == 1 else {},
    )


def _predicted(outcomes: Sequence[Outcome], seed: int, scale: Scale) -> dict[int, PredictedScores]:
    """Return what the surrogate of `gpr` predicts after some batches of a search at level 1."""
    axis = np.linspace(0.0, 1.0, SURFACE_POINTS)
    grid = np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2)
    result = {}
    for batch in (b for b in SURFACE_BATCHES if b <= scale.batches):
        known = [outcome for outcome in outcomes if outcome.batch < batch]
        sampler = make_sampler("gpr", Pool(levels=(1,), scenario=US23), seed)
        sampler.tell(known)
        score = predicted_score(sampler.history(1), grid)
        square = score.reshape(SURFACE_POINTS, SURFACE_POINTS)
        result[batch] = PredictedScores(square, _panel(known, 1))
    return result


def _median_seed(searches: Sequence[Search]) -> int:
    """Return the seed whose coverage is the median, the lower one of two."""
    order = sorted(range(len(searches)), key=lambda seed: (searches[seed].fmc[-1], seed))
    return order[(len(order) - 1) // 2]


def _panel(outcomes: Sequence[Outcome], level: int) -> Panel:
    points = to_unit((outcome.case for outcome in outcomes), level, US23)
    failed = np.array([outcome.failed for outcome in outcomes])
    return Panel(points, failed, fmc(points[failed]))


def _level_batches(searches: Sequence[Search]) -> LevelBatches:
    shape = len(LEVELS), len(searches), len(searches[0].fmc)
    cases, judged, total = np.zeros((3, *shape))
    for seed, one in enumerate(searches):
        for outcome in one.outcomes:
            place = LEVELS.index(outcome.case.level), seed, outcome.batch
            cases[place] += 1
            if outcome.measures.score is not None:
                judged[place] += 1
                total[place] += outcome.measures.score
    score = np.divide(total, judged, out=np.full(shape, np.nan), where=judged > 0)
    return LevelBatches(
        dict(zip(LEVELS, cases, strict=True)), dict(zip(LEVELS, score, strict=True))
    )


# The file.


def _write(folder: Path, result: Reproduction) -> None:
    replace_own(folder / REPRODUCTION, msgspec.json.encode(result, enc_hook=np.ndarray.tolist))


def read_reproduction(folder: Path) -> Reproduction:
    """Return what `reproduce` left in a folder; `UserError` where it left nothing readable."""
    path = folder / REPRODUCTION
    try:
        content = regular(path).read_bytes()
        return msgspec.json.decode(content, type=Reproduction, dec_hook=_array)
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error}") from error
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
        raise UserError(f"{path} is not as it was written") from error


def _array(kind: Any, values: Any) -> NDArray[Any]:
    """Return lists of numbers as an array of a type; null is NaN."""
    (dtype,) = get_args(get_args(kind)[1])
    return np.array(values, dtype=dtype)


# Table II.


def table_rows(
    columns: Mapping[str, ColumnResult],
) -> Iterator[tuple[str, list[tuple[float | None, float | None]]]]:
    """Yield the rows of the table: a name, and (ours, the paper's) for each column."""
    results = columns.values()
    yield "truth", [(r.truth_fmc, r.column.paper["truth"]) for r in results]
    if any(r.dense_fmc is not None for r in results):
        yield "dense truth", [(r.dense_fmc, None) for r in results]
    yield "limit", [(r.limit_fmc, None) for r in results]
    for name in SAMPLERS:
        yield name, [(r.compared[name].fmc_median, r.column.paper.get(name)) for r in results]


def table_markdown(columns: Mapping[str, ColumnResult]) -> str:
    """Return Table II as Markdown: our medians, with the paper's numbers in brackets."""
    results = list(columns.values())
    lines = ["| FMC: ours (the paper's) | " + " | ".join(columns) + " |"]
    lines.append("|---|" + "---|" * len(columns))

    def add(title: str, cells: Sequence[str]) -> None:
        lines.append(f"| {title} | " + " | ".join(cells) + " |")

    for name, pairs in table_rows(columns):
        add(name, [f"{_or_dash(ours, '.4f')} ({_or_dash(paper, '.4f')})" for ours, paper in pairs])
    for name in ADAPTIVE:
        cells = []
        for result in results:
            paper = result.column.paper
            share = paper[name] / paper["truth"] if name in paper else None
            ours = result.compared[name].fmc_over_truth_median
            cells.append(f"{_or_dash(ours, '.2f')} ({_or_dash(share, '.2f')})")
        add(f"{name} / truth", cells)
    if any(result.dense_fmc for result in results):
        for name in ADAPTIVE:
            medians = [(r.compared[name].fmc_median, r.dense_fmc) for r in results]
            cells = [_or_dash(ours / dense if dense else None, ".3f") for ours, dense in medians]
            add(f"{name} / dense truth", cells)
    for name in ADAPTIVE:
        add(
            f"{name} / limit",
            [_or_dash(r.compared[name].fmc_over_limit_median, ".2f") for r in results],
        )
    for name in ADAPTIVE:
        after = results[0].compared[name].cases_by_batch
        # A quarter of all cases, or where a batch ended next.
        cases = next(number for number in after if number >= after[-1] / 4)
        early = [(r.compared[name].fmc_by_batch_median[after.index(cases)], r) for r in results]
        shares = [
            None if r.compared[name].fmc_over_truth_median is None else median / r.truth_fmc
            for median, r in early
        ]
        add(f"{name} / truth after {cases} cases", [_or_dash(share, ".2f") for share in shares])
    for title, result in columns.items():
        lines += [f"\nThe truth of {title} is {remark}." for remark in result.truth_remarks]
    return "\n".join(lines) + "\n"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def table_record(result: Reproduction) -> dict[str, Any]:
    """Return Table II for a program; without seconds, so that it can be compared bit by bit."""
    columns = []
    for one in result.columns.values():
        samplers = {name: asdict(summary) for name, summary in one.compared.items()}
        for summary in samplers.values():
            del summary["sampler_s_median"]
        columns.append(
            {
                "vut": one.column.vut,
                "level": one.column.level,
                "truth_fmc": one.truth_fmc,
                "truth_failures": one.truth_failures,
                "truth_regions": one.truth_regions,
                "limit_fmc": one.limit_fmc,
                "dense_fmc": one.dense_fmc,
                "paper_fmc": dict(one.column.paper),
                "samplers": samplers,
            }
        )
    return {"scale": asdict(result.scale), "versions": result.versions, "columns": columns}
