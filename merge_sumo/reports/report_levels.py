"""What the report says of each POV level: counts, bars, what its map shows, notes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from merge_sumo.analysis.summary import LevelSummary
from merge_sumo.analysis.surface import FEWEST_FAILURES
from merge_sumo.analysis.verdict import counted
from merge_sumo.reports.report_maps import pairs_of
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.system.printable import two_digits
from merge_sumo.values.empty_ball import EmptyBall
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import OWN, level_name


@dataclass(frozen=True, slots=True)
class Third:
    """A coordinate that the reader of a map moves through, and its bounds."""

    name: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Level:
    """What the page says of a level; bars are shares of 100."""

    level: int
    name: str
    caption: str
    about: str
    cases: int
    failures: int
    untested: int
    share_bar: float
    untested_bar: float
    fmc: float | None
    fmc_bar: float | None
    plausible: float | None
    plausible_bar: float
    truth: float | None
    truth_bar: float
    note: str
    dims: int
    third: Third | None
    pairs: list[str]


ABOUT: Final = {
    0: "keeps its speed",
    1: "makes room for a VUT that accelerates",
    2: "expects a VUT that thinks; psi 0 is egoistic, pi/2 cares for the VUT",
}


FMC_AXES: Final = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Ends of an axis of coverages; balls at the faces of the pool reach out of it."""


def levels_of(facts: ReportModel) -> tuple[list[Level], str]:
    """Return what the page says of each level, and the end of the axis of the coverages."""
    plausible = {
        level: None if surface is None else surface.plausible_fmc()
        for level, surface in facts.surfaces.items()
    }
    truth = {
        level: None if found is None else fmc(found.failures)
        for level, found in facts.truths.items()
    }
    end = _fmc_axis(facts, plausible, truth)

    def row(level: int, found: LevelSummary) -> Level:
        # Found against what there may be: a bar shows nothing where only one of them is known.
        known = plausible[level] is not None or truth[level] is not None
        scale = 100.0 / end if known else 0.0
        share = 100.0 / found.cases if found.cases else 0.0
        return Level(
            level=level,
            name=level_name(level),
            caption=f"own: {facts.run.pov}" if level == OWN else str(level),
            about=ABOUT.get(level, ""),
            cases=found.cases,
            failures=found.failures,
            untested=found.cases - found.tested,
            share_bar=round(share * found.failures, 1),
            untested_bar=round(share * (found.cases - found.tested), 1),
            fmc=found.fmc if found.tested else None,
            fmc_bar=round(scale * found.fmc, 1) if scale else None,
            plausible=plausible[level],
            plausible_bar=round(scale * (plausible[level] or 0.0), 1),
            truth=truth[level],
            truth_bar=round(scale * (truth[level] or 0.0), 1),
            note=_note(facts, level, found),
            dims=len(facts.run.scenario.dimensions(level)),
            third=_third(facts, level),
            pairs=_pairs(facts, level),
        )

    levels = [row(level, found) for level, found in facts.summary.levels.items()]
    return levels, f"{end:g}" if any(level.fmc_bar is not None for level in levels) else ""


def _fmc_axis(
    facts: ReportModel, plausible: Mapping[int, float | None], truth: Mapping[int, float | None]
) -> float:
    """Return the coverage at which the bars of all levels end: a round number."""
    most = max(
        (
            max(found.fmc, plausible[level] or 0.0, truth[level] or 0.0)
            for level, found in facts.summary.levels.items()
        ),
        default=0.0,
    )
    return next((end for end in FMC_AXES if most <= end), FMC_AXES[-1])


def _third(facts: ReportModel, level: int) -> Third | None:
    if len(facts.run.scenario.dimensions(level)) != 3:
        return None
    found = facts.coordinates_of(level)[2]
    return Third(found.name, round(found.dimension.low, 2), round(found.dimension.high, 2))


def _pairs(facts: ReportModel, level: int) -> list[str]:
    """Return the pairs of coordinates that a level's map may show, the first one first."""
    found = facts.coordinates_of(level)
    return [
        " × ".join(found[axis].name for axis in pair.axes)
        + ("" if pair.share is None else f": {pair.share:.0%}")
        for pair in pairs_of(len(found), facts.surfaces[level])
    ]


def _note(facts: ReportModel, level: int, found: LevelSummary) -> str:
    if found.cases and not found.tested:
        return f"Nothing was tested in {counted(found.cases, 'case')}."
    text = f"{counted(found.failures, 'failure')} in {counted(found.cases, 'case')}"
    if found.failures:
        text += f", {counted(found.regions, 'region')}"
    if found.tested < found.cases:
        text += f"; {found.cases - found.tested} not tested"
    if found.unseen is not None:
        text += f". {_unseen(facts, level, found.unseen)}"
    if facts.surfaces[level] is None:
        text += f". No surrogate: it takes {FEWEST_FAILURES} failures to learn one"
    return text + "."


def _unseen(facts: ReportModel, level: int, ball: EmptyBall) -> str:
    """Return the largest ball that no case has entered, in a clause."""
    axes = facts.coordinates_of(level)
    spans = [(c, c.dimension.high - c.dimension.low) for c in axes]
    radii = ", ".join(f"{two_digits(ball.radius * span)} {c.unit}" for c, span in spans)
    centre = ", ".join(
        f"{c.name} {c.dimension.low + share * span:.{c.digits}f}"
        for (c, span), share in zip(spans, ball.centre, strict=True)
    )
    more = ball.at_most > 1.01 * ball.radius
    return (
        f"The largest ball that no case has entered has {'at least ' if more else ''}a radius of "
        f"{ball.radius:.0%} of the axes ({radii}), around {centre}"
    )
