"""The page of a repair: values, what they cost, the trade-off of all trials, the fresh campaign.

It is one HTML file without scripts that loads nothing.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

from merge_sumo.analysis.coordinates import described
from merge_sumo.campaigns.store import Run
from merge_sumo.reports.pages import page
from merge_sumo.reports.version_pages import STYLES, Frame, axis_end
from merge_sumo.studies.repair import CHANGES, MEASURED_BY, Repair, Trial, change_of
from merge_sumo.system.printable import quoted

FRAME: Final = Frame(56.0, 512.0, 22.0, 250.0)
MOST_STAYING: Final = 50
"""Cases that are listed of those that still fail."""
MOST_TRADES: Final = 20
"""Rows of the table of trade-offs."""


@dataclass(frozen=True, slots=True)
class Mark:
    """A trial in the picture: its place, CSS class, radius, and words."""

    x: float
    y: float
    css: str
    radius: float
    words: str


@dataclass(frozen=True, slots=True)
class TradeOff:
    """The picture of failing cases against extra cost; ticks are (pixel, words)."""

    marks: list[Mark]
    across: list[tuple[float, str]]
    up: list[tuple[float, str]]
    label: str


def repair_page(repair: Repair, before: Run) -> str:
    """Return the page of a repair as HTML; `before` is the campaign that it repairs."""
    chosen = repair.chosen
    return page(
        "repair.html.jinja",
        styles=STYLES,
        repair=repair,
        before=before,
        chosen=chosen,
        unit=MEASURED_BY[repair.settings.cost][1],
        costs=MEASURED_BY,
        picture=_trade_off(repair),
        trades=_trades(repair),
        stays=[(index, described(before.outcome(index).case)) for index in repair.stays][
            :MOST_STAYING
        ],
        change=0.0 if chosen is None else repair.change(chosen),
        commands=[]
        if repair.spec is None
        else [
            f"merge-sumo campaign --vut {quoted(repair.spec)}",
            f"merge-sumo rerun {quoted(before.folder)} --vut {quoted(repair.spec)}",
        ],
        changes=CHANGES,
    )


def _trades(repair: Repair) -> list[Trial]:
    """Return the trials that no other is better than, the fewest failing cases first."""
    cost = repair.settings.cost
    by_values = {tuple(trial.values.values()): trial for trial in repair.pareto()}
    ranked = sorted(by_values.values(), key=lambda t: (len(t.fails), t.extra[cost]))
    return ranked[:MOST_TRADES]


def _trade_off(repair: Repair) -> TradeOff:
    """Return the picture of the last round's trials."""
    cost = repair.settings.cost
    last = repair.best.chosen.round if repair.best.chosen else 1
    shown = [t for t in repair.trials if t.round == last and not t.refused and not t.all_cases]
    extra = [trial.extra[cost] for trial in shown]
    low, high = min(0.0, *extra), max(0.0, *extra)
    span = max(high - low, 1e-3)
    most = axis_end([float(len(trial.fails)) for trial in shown])
    best = {tuple(trial.values.values()) for trial in repair.pareto()}
    marks = []
    for trial in sorted(shown, key=lambda trial: -len(trial.broke)):
        css, radius = ("level0", 3.5) if trial.holds else ("broken", 3.0)
        if trial.holds and tuple(trial.values.values()) in best:
            css = "level1"
        if repair.chosen is not None and trial.values == repair.chosen.values:
            css, radius = "kind0", 6.0
        x = FRAME.x((trial.extra[cost] - low) / span)
        y = FRAME.y(len(trial.fails) / most)
        marks.append(Mark(x, y, css, radius, _words(repair, trial)))
    across = [(FRAME.x(s), f"{low + s * span:.2f}".replace("-", "−")) for s in (0.0, 0.5, 1.0)]
    up = [(FRAME.y(s), f"{s * most:g}") for s in (0.0, 0.5, 1.0)]
    unit = MEASURED_BY[cost][1]
    return TradeOff(marks, across, up, f"extra {cost}, mean of a case, {unit}")


def _words(repair: Repair, trial: Trial) -> str:
    """Return what a trial is, for a pointer above it."""
    values = ", ".join(f"{name} {value:g}" for name, value in trial.values.items())
    change = change_of(trial.values, repair.today, repair.settings.ranges)
    broke = f", {len(trial.broke)} broke" if trial.broke else ""
    return f"{values}: {len(trial.fails)} fail{broke}; change {change:.2f}"
