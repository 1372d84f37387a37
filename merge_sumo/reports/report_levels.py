"""What the report says of each POV level: counts, bars, what its map shows, notes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from merge_sumo.analysis.coordinates import Coordinate
from merge_sumo.analysis.summary import LevelSummary
from merge_sumo.analysis.surface import FEWEST_FAILURES
from merge_sumo.reports.report_maps import pairs_of
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.studies.truth import Truth
from merge_sumo.system.printable import counted
from merge_sumo.values.case import to_unit
from merge_sumo.values.fmc import covered, fmc, radius_for
from merge_sumo.values.scenario import OWN


@dataclass(frozen=True, slots=True)
class Level:
    """What the page says of a POV level.

    Attributes:
        found: what the cases have shown there.
        caption: the level, or the name of a POV of the tester's own; `about` says what it does.
        plausible: coverage if all places failed that the surrogate does not exclude.
        truth: coverage of the truth.
        note: what was found, in sentences.
        pairs: pairs of its axes that its map may show, the first one first.
    """

    level: int
    found: LevelSummary
    caption: str
    about: str
    plausible: float | None
    truth: float | None
    note: str
    axes: tuple[Coordinate, ...]
    pairs: list[str]

    @property
    def has_bar(self) -> bool:
        """Whether a bar shows the coverage found against what there may be."""
        return self.plausible is not None or self.truth is not None

    @property
    def most(self) -> float:
        """The largest of its coverages."""
        return max(self.found.fmc, self.plausible or 0.0, self.truth or 0.0)


FMC_AXES: Final = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5, 1.0, 2.0)
"""Ends of an axis of coverages; balls at the faces of the pool reach out of it."""


def levels_of(model: ReportModel) -> tuple[list[Level], float]:
    """Return what the page says of each level, and the coverage at which all bars end."""
    levels = [_level(model, level, found) for level, found in model.summary.levels.items()]
    most = max((level.most for level in levels), default=0.0)
    return levels, next((end for end in FMC_AXES if most <= end), FMC_AXES[-1])


def _level(model: ReportModel, level: int, found: LevelSummary) -> Level:
    surface, truth = model.surfaces[level], model.truths[level]
    axes = model.coordinates_of(level)
    note = _note(found, axes, learned=surface is not None)
    if truth is not None and len(truth.failures):
        note += f" {_of_truth(model, level, truth)}"
    return Level(
        level=level,
        found=found,
        caption=f"own: {model.run.pov}" if level == OWN else str(level),
        about=model.run.scenario.level_about.get(level, ""),
        plausible=None if surface is None else surface.plausible_fmc(),
        truth=None if truth is None else fmc(truth.failures),
        note=note,
        axes=axes,
        pairs=[
            " × ".join(axes[axis].name for axis in pair.axes)
            + ("" if pair.share is None else f": {pair.share:.0%}")
            for pair in pairs_of(len(axes), surface)
        ],
    )


def _note(found: LevelSummary, axes: tuple[Coordinate, ...], *, learned: bool) -> str:
    if found.cases and not found.tested:
        return f"Nothing was tested in {counted(found.cases, 'case')}."
    text = f"{counted(found.failures, 'failure')} in {counted(found.cases, 'case')}"
    if found.failures:
        text += f", {counted(found.regions, 'region')}"
    if found.tested < found.cases:
        text += f"; {found.cases - found.tested} not tested"
    if not learned:
        text += f". No surrogate: it takes {FEWEST_FAILURES} failures to learn one"
    return text + "."


def _of_truth(model: ReportModel, level: int, truth: Truth) -> str:
    """Return the covered share of a truth with failures, and for what it is too small."""
    cases = (o.case for o in model.cases if o.failed and o.case.level == level)
    found, failing = to_unit(cases, level), truth.failures
    near = int(covered(failing, found).sum())
    text = (
        f"Of {counted(len(failing), 'failure')} of the truth, {near} lie within "
        f"{radius_for(failing.shape[1]):.2f} of a failure found ({near / len(failing):.0%})"
    )
    return ". The truth is ".join([text, *truth.remarks()]) + "."
