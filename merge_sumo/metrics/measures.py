"""Measures of an episode: what each is, its unit, and how it is shown.

The fields of `Measures` are computed together, by `score.py`. A further measure has a function of
its own, `of`: it is recorded under its name after the fields, conditions may name it, and the
report, exports and documentation show it like any other.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from functools import cache, partial
from traceback import extract_tb
from typing import Final, Literal

from merge_sumo.errors import UserError
from merge_sumo.metrics.bodies import CentreLines
from merge_sumo.registry import Registry
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.scenario.trajectory import Trajectory

Further = tuple[tuple[str, float], ...]
"""Values of further measures by name; one without a value is left out."""


@dataclass(frozen=True, slots=True)
class Measure:
    """A measure of an episode."""

    name: str  # in records and conditions, with the unit at its end
    about: str  # what it is, in a sentence without its full stop
    unit: str = ""  # as a person reads it; empty for a number without one and for a text
    label: str = ""  # name in the listing of an episode; empty where that leaves it out
    column: str = ""  # name in the table of the report; empty where that leaves it out
    digits: int = 1  # decimals in tables
    missing: float | None = None
    """What a condition takes where an episode has no value: that of cars that never meet; None
    for a measure that is no number."""
    worse: Literal["low", "high"] | None = None
    """At which end of its values an episode is worse, if at one."""
    of: Callable[[Trajectory, CentreLines | None], float | None] | None = None
    """Measures an episode on a road, and returns None where that has no value; None for the
    fields of `Measures`."""

    def label_in(self, scenario: Scenario) -> str:
        """Return its name in the listing of an episode of a scenario."""
        return scenario.said(self.label)

    def title_in(self, scenario: Scenario) -> str:
        """Return name and unit, as the head of a column of a scenario shows them."""
        name = scenario.said(self.column)
        return f"{name} {self.unit}".replace("s2", "s²").rstrip()


_low = partial(Measure, missing=math.inf, worse="low")
"""Makes a measure of which low values are worse; cars that never meet have none, which is high."""
_high = partial(Measure, missing=0.0, worse="high")
"""Makes one of which high values are worse."""
OURS: Final = (
    Measure("end", "why the episode ended"),
    Measure(
        "severity",
        "contact, conflict, harsh or safe (`severity.py`); None where the VUT never reached M, "
        "and after an error",
    ),
    Measure(
        "score",
        "P, never positive; None without a verdict (VUT_ERROR, SIM_ERROR)",
        label="score P",
        digits=0,
        missing=0.0,
        worse="low",
    ),
    Measure(
        "dx_m",
        "x_POV - x_VUT, of the front bumpers",
        unit="m",
        label="front bumpers, x_POV - x_VUT",
        column="Δx at M",
        missing=math.inf,
    ),
    _low(
        "bumper_gap_m",
        "smallest gap at M between the front bumper of the car behind and the rear bumper of the "
        "car ahead, negative where bodies overlap; None without a merge",
        unit="m",
        label="bumper gap at M",
        column="bumper gap at M",
    ),
    _low(
        "clearance_m",
        "smallest gap between bumpers from M on, to the end of the follow-up; 0 or less where "
        "bodies touch, None without a merge",
        unit="m",
        label="smallest gap from M on",
        column="clearance",
    ),
    _low(
        "before_clearance_m",
        "smallest distance of bodies before M, where the lanes run together; 0 or less where they "
        "overlap, None where the VUT never came there",
        unit="m",
        label="smallest clearance before M",
        column="clearance before M",
    ),
    Measure("dv_mps", "v_POV - v_VUT", unit="m/s", label="v_POV - v_VUT", column="dv", missing=0.0),
    _low(
        "ttc_s",
        "time to collision -dx/dv where dx dv < 0, else None (infinite)",
        unit="s",
        label="time to collision",
        column="TTC",
    ),
    _low(
        "pet_s",
        "post-encroachment time: time between the two front bumpers at M (Allen et al., 1978); "
        "where the POV has not arrived by t1, it is taken on at its speed at t1; None when it "
        "stands",
        unit="s",
        label="post-encroachment time",
        column="PET",
    ),
    Measure("t_end_s", "time at which the episode ended", unit="s", column="time", missing=0.0),
    _high(
        "drac_mps2",
        "deceleration rate to avoid a crash that the follower needs at t1 (Cooper and Ferguson, "
        "1976), dv^2 / (2 (|dx| - 6)); 0 when the gap opens, None where |dx| < 6 m",
        unit="m/s2",
        label="deceleration to keep 6 m apart",
    ),
    _high(
        "brake_after_mps2",
        "deceleration that whoever is behind at M needs, after 0.75 s to react, not to touch a "
        "car ahead that keeps its speed (`merge.py`); None where none is in time, and without a "
        "merge",
        unit="m/s2",
        label="braking that M asks of the rear",
        column="braking asked after M",
    ),
    _high(
        "impact_speed_mps",
        "relative speed at the first contact; None without one",
        unit="m/s",
        label="impact speed",
        column="impact",
    ),
    _high(
        "vut_max_brake_mps2",
        "hardest braking of the VUT, positive",
        unit="m/s2",
        label="hardest braking of the VUT",
        column="VUT brakes",
    ),
    _high(
        "pov_max_brake_mps2",
        "hardest braking of the POV, positive",
        unit="m/s2",
        label="hardest braking of the POV",
        column="POV brakes",
    ),
    _high(
        "pov_sustained_brake_mps2",
        "largest mean deceleration of the POV over 1.6 s, or over an episode that is shorter; None "
        "in records of versions without it, as the next",
        unit="m/s2",
        label="braking of the POV over 1.6 s",
        column="POV brakes over 1.6 s",
    ),
    _high(
        "pov_slowdown_mps",
        "largest loss of speed of the POV up to t1, from the highest speed that it had before",
        unit="m/s",
        label="slow-down of the POV",
        column="POV slows by",
    ),
    Measure("merged_first", '"VUT" or "POV": whose front bumper is ahead at M'),
    _low(
        "last_avoidable_s",
        "where |dx| < 6 m at M, the last time from which the VUT, at full acceleration or full "
        "braking by eq. (4), would have kept 6 m against the recorded motion of the POV and the "
        "other cars (taken on at their last speed); None when there was no such time, and where "
        "|dx| >= 6 m",
        unit="s",
        label="avoidable until",
    ),
    Measure("avoidable", "where |dx| < 6 m at M, whether there was such a time; else None"),
    _high(
        "clipped_steps",
        "steps in which the VUT asked for more than its limits of acceleration",
        digits=0,
    ),
    Measure("error", "what the VUT or the simulation did wrong, also behind M, else None"),
    Measure("nearest", "name of the car that the measures are of; recorded in traffic only"),
    _low(
        "after_gap_m",
        "least gap between bumpers in the follow-up, 0 or less where bodies touch; this and the "
        "next three are None without a merge, and recorded where there is a follow-up only",
        unit="m",
        label="smallest bumper gap behind M",
    ),
    _low(
        "after_ttc_s",
        "lowest time to collision in it, between bumpers; None where no gap closes",
        unit="s",
        label="time to collision behind M",
    ),
    _high(
        "after_drac_mps2",
        "hardest braking that it needs, dv^2 / (2 gap); None where bodies touch",
        unit="m/s2",
        label="braking needed behind M",
    ),
    _high(
        "after_brake_mps2",
        "hardest braking in it of the cars behind the VUT, and of the VUT behind the nearest car",
        unit="m/s2",
        label="hardest braking behind M",
    ),
    Measure(
        "x_merge_m",
        "on an acceleration lane, where the VUT merges; this and the next six are recorded there "
        "only, and None without a merge",
        unit="m",
        label="place of the merge",
        column="merges at",
        missing=math.inf,
    ),
    Measure(
        "lane_share",
        "place of the merge as a share of the acceleration lane, from its begin",
        label="share of the lane",
        column="share of the lane",
        digits=2,
        missing=math.inf,
    ),
    _low(
        "gap_ahead_m",
        "bumper gap at the merge to the car ahead; None without one, as the next three",
        unit="m",
        label="gap ahead at the merge",
    ),
    _low(
        "gap_behind_m",
        "bumper gap at the merge to the car behind",
        unit="m",
        label="gap behind at the merge",
    ),
    _low(
        "time_gap_ahead_s",
        "gap ahead over the speed of the VUT",
        unit="s",
        label="time gap ahead at the merge",
        column="time gap ahead",
        digits=2,
    ),
    _low(
        "time_gap_behind_s",
        "gap behind over the speed of the car behind",
        unit="s",
        label="time gap behind at the merge",
        column="time gap behind",
        digits=2,
    ),
    _high(
        "stood_s",
        "time for which the VUT stood on the acceleration lane",
        unit="s",
        label="stood on the lane",
        column="stood",
    ),
)
"""The fields of `Measures`, in the order in which an episode is listed, then measures with `of`."""

RESERVED: Final = frozenset({"index", "batch", "level", "margin", "foretold"})
"""Names of a record that are no measures."""


def _is_measure(item: object) -> bool:
    return (
        isinstance(item, Measure)
        and (item in OURS or (item.of is not None and item.missing is not None))
        and item.name.isidentifier()
        and item.name not in RESERVED
    )


MEASURES: Final[Registry[Measure]] = Registry(
    "merge_sumo.measures",
    "measure",
    {measure.name: measure for measure in OURS},
    accepts=_is_measure,
    contract=(
        "a merge_sumo.metrics.measures.Measure with a function `of`, a number `missing`, and a "
        f"name that is an identifier and none of {', '.join(sorted(RESERVED))}"
    ),
)


@cache
def further_measures() -> dict[str, Measure]:
    """Return the measures with a function of their own, by name; for a process they stay."""
    return {name: measure for name, measure in MEASURES.items() if measure.of is not None}


def further_of(
    trajectory: Trajectory, lines: CentreLines | None, names: Iterable[str] | None = None
) -> Further:
    """Measure an episode by further measures, all or those of some names.

    Args:
        trajectory: what happened; after an error no measure has a value.
        lines: centre lines of the road, where they are known.
        names: of measures; others than further ones are left out.

    Raises:
        UserError: where a measure fails, or gives no number.
    """
    chosen = further_measures()
    if names is not None:
        chosen = {name: chosen[name] for name in names if name in chosen}
    return with_values({name: _value(one, trajectory, lines) for name, one in chosen.items()})


def with_values(measured: Mapping[str, float | None]) -> Further:
    """Leave out the measures that have no value."""
    return tuple((name, value) for name, value in measured.items() if value is not None)


def _value(measure: Measure, trajectory: Trajectory, lines: CentreLines | None) -> float | None:
    if trajectory.end.is_error or measure.of is None:
        return None
    try:
        value = measure.of(trajectory, lines)
        number = None if value is None else float(value)
    except Exception as error:
        last = extract_tb(error.__traceback__)[-1]
        raise UserError(
            f"the measure {measure.name!r} failed in {last.filename}, line {last.lineno}: "
            f"{type(error).__name__}: {error}"
        ) from error
    return number if number is not None and math.isfinite(number) else None
