"""Table II of the paper: its columns, how much is run for them, and our numbers beside the paper's.

Every number is the median over seeds.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any, Final

from merge_sumo.engine.versions import versions
from merge_sumo.errors import UserError
from merge_sumo.studies.benchmark import Comparison
from merge_sumo.studies.truth import TRUTH_CASES

SAMPLERS: Final = ("uniform", "annealing", "subset", "gpr", "coverage")
ADAPTIVE: Final = ("gpr", "coverage")
"""The paper's sampler and ours: whose shares of the truth and of the levels are shown."""


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
        """Check the number of seeds."""
        if self.seeds < 1:
            raise UserError(f"--seeds is {self.seeds}: it must be 1 or more")


def quick(seeds: int) -> Scale:
    """Return a scale for a first look and for tests: it shows that all works, and no more."""
    return Scale(seeds=seeds, truth_cases=(1000, 1000, 1000), batches=4, batch=15, dense=False)


@dataclass(frozen=True, slots=True)
class Result:
    """A column that has run: what the truth holds, and each sampler beside it.

    `dense_fmc` is that of a dense truth, if there is one; `limit_fmc` is the coverage of all that
    is known to fail.
    """

    column: Column
    truth_fmc: float
    truth_failures: int
    truth_regions: int
    dense_fmc: float | None
    limit_fmc: float
    compared: dict[str, Comparison]


def table_rows(
    table: Mapping[str, Result],
) -> Iterator[tuple[str, list[tuple[float | None, float | None]]]]:
    """Yield the rows of the table: a name, and (ours, the paper's) for each column."""
    results = table.values()
    yield "truth", [(r.truth_fmc, r.column.paper["truth"]) for r in results]
    if any(r.dense_fmc is not None for r in results):
        yield "dense truth", [(r.dense_fmc, None) for r in results]
    yield "limit", [(r.limit_fmc, None) for r in results]
    for name in SAMPLERS:
        yield name, [(r.compared[name].fmc_median, r.column.paper.get(name)) for r in results]


def table_markdown(table: Mapping[str, Result]) -> str:
    """Return Table II as Markdown: our medians, with the paper's numbers in brackets."""
    lines = ["| FMC: ours (the paper's) | " + " | ".join(table) + " |"]
    lines.append("|---|" + "---|" * len(table))
    for name, pairs in table_rows(table):
        cells = [f"{_or_dash(ours, '.4f')} ({_or_dash(paper, '.4f')})" for ours, paper in pairs]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    for name in ADAPTIVE:
        cells = []
        for result in table.values():
            paper = result.column.paper
            share = paper[name] / paper["truth"] if name in paper else None
            ours = result.compared[name].fmc_over_truth_median
            cells.append(f"{_or_dash(ours, '.2f')} ({_or_dash(share, '.2f')})")
        lines.append(f"| {name} / truth | " + " | ".join(cells) + " |")
    if any(result.dense_fmc for result in table.values()):
        for name in ADAPTIVE:
            found = ((r.compared[name].fmc_median, r.dense_fmc) for r in table.values())
            cells = [_or_dash(ours / dense if dense else None, ".3f") for ours, dense in found]
            lines.append(f"| {name} / dense truth | " + " | ".join(cells) + " |")
    for name in ADAPTIVE:
        shares = (result.compared[name].fmc_over_limit_median for result in table.values())
        cells = [_or_dash(share, ".2f") for share in shares]
        lines.append(f"| {name} / limit | " + " | ".join(cells) + " |")
    for name in ADAPTIVE:
        results = [(result, result.compared[name]) for result in table.values()]
        after = results[0][1].cases_by_batch
        # A quarter of all cases, or where a batch ended next.
        cases = next(number for number in after if number >= after[-1] / 4)
        early = after.index(cases)
        cells = [
            _or_dash(
                found.fmc_by_batch_median[early] / result.truth_fmc if result.truth_fmc else None,
                ".2f",
            )
            for result, found in results
        ]
        lines.append(f"| {name} / truth after {cases} cases | " + " | ".join(cells) + " |")
    return "\n".join(lines) + "\n"


def _or_dash(value: float | None, form: str) -> str:
    return "-" if value is None else f"{value:{form}}"


def table_record(table: Mapping[str, Result], scale: Scale) -> dict[str, Any]:
    """Return Table II for a program; without seconds, so that it can be compared bit by bit."""
    columns = []
    for result in table.values():
        samplers = {name: asdict(found) for name, found in result.compared.items()}
        for found in samplers.values():
            del found["sampler_s_median"]
        columns.append(
            {
                "vut": result.column.vut,
                "level": result.column.level,
                "truth_fmc": result.truth_fmc,
                "truth_failures": result.truth_failures,
                "truth_regions": result.truth_regions,
                "limit_fmc": result.limit_fmc,
                "dense_fmc": result.dense_fmc,
                "paper_fmc": dict(result.column.paper),
                "samplers": samplers,
            }
        )
    return {"scale": asdict(scale), "versions": versions(), "columns": columns}
