"""Captions of the maps of the report, and what is known of each POV level beside its facts."""

from __future__ import annotations

from dataclasses import dataclass

from merge_sumo.analysis.coordinates import Coordinate
from merge_sumo.analysis.summary import LevelSummary
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
        notes: sentences on the truth.
        pairs: pairs of its axes that its map may show, the first one first.
    """

    level: int
    found: LevelSummary
    caption: str
    about: str
    plausible: float | None
    truth: float | None
    notes: list[str]
    axes: tuple[Coordinate, ...]
    pairs: list[str]


def levels_of(model: ReportModel) -> list[Level]:
    """Return what the page says of each level."""
    return [_level(model, level, found) for level, found in model.summary.levels.items()]


def _level(model: ReportModel, level: int, found: LevelSummary) -> Level:
    surface, truth = model.surfaces[level], model.truths[level]
    axes = model.coordinates_of(level)
    notes = []
    if truth is not None and len(truth.failures):
        notes.append(_of_truth(model, level, truth))
    return Level(
        level=level,
        found=found,
        caption=f"own: {model.run.pov}" if level == OWN else str(level),
        about=model.run.scenario.level_about.get(level, ""),
        plausible=None if surface is None else surface.plausible_fmc(),
        truth=None if truth is None else fmc(truth.failures),
        notes=notes,
        axes=axes,
        pairs=[
            " × ".join(axes[axis].name for axis in pair.axes)
            + ("" if pair.share is None else f": {pair.share:.0%}")
            for pair in pairs_of(len(axes), surface)
        ],
    )


def _of_truth(model: ReportModel, level: int, truth: Truth) -> str:
    """Return the covered share of a truth with failures, and for what it is too small."""
    cases = (o.case for o in model.cases if o.failed and o.case.level == level)
    found, failing = to_unit(cases, level), truth.failures
    near = int(covered(failing, found).sum())
    text = (
        f"Of {counted(len(failing), 'failure')} of the truth {near} lie within "
        f"{radius_for(failing.shape[1]):.2f} of a failure found ({near / len(failing):.0%})"
    )
    return ". The truth is ".join([text, *truth.remarks()]) + "."
