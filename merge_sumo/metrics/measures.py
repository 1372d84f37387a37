"""Measures of an episode: decorated functions of `Measures`, or of installed packages.

The function has the name of the measure in records and conditions, with the unit at its end, and
its docstring is the definition. `OURS` has the measures of this package, and `MEASURES` also those
of others. Records (`Outcome.to_record`), `--fail-when` (`criterion.vocabulary`), the table of the
report (`report_data.page_data`) and the listing of `run` (`text._measures`) loop over them.

A new measure of this package, unless it is of the follow-up, is required in records
(`outcome.record_of`): campaigns of earlier versions can then not be read any more.

    from merge_sumo.metrics.measures import Measures, measure

    @measure(missing=math.inf)
    def closest_m(episode: Measures) -> float:
        \"\"\"Least distance of the front bumpers.\"\"\"
        return float(np.abs(episode.trajectory.x_pov_m - episode.trajectory.x_vut_m).min())
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from traceback import extract_tb
from typing import Any, Generic, Literal, TypeVar

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.metrics.bodies import (
    NONE_MET,
    CentreLines,
    Encounter,
    encounters,
    gaps_m,
    times_to_collision_s,
)
from merge_sumo.metrics.merge import (
    HARSH_MPS2,
    STANDS_MPS,
    Severity,
    brake_after_mps2,
    gaps_at_m,
    last_avoidable_s,
    place_of_merge_m,
)
from merge_sumo.metrics.paper import FAILURE_SCORE, merge_score, time_to_collision
from merge_sumo.registry import Registry
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, POV, VEHICLES, VUT, Scenario, Vehicle
from merge_sumo.scenario.trajectory import End, Trajectory, as_reason

T = TypeVar("T")

UNITS = {"m": "m", "s": "s", "mps": "m/s", "mps2": "m/s2"}
"""Units by the last part of the name of a measure."""
SUSTAINED_STEPS = 16
"""Steps over which braking counts as sustained: 1.6 s, as in published braking of drivers."""
FOLLOW_UP = "a follow-up"
LANE = "an acceleration lane"
TRAFFIC = "traffic"


@dataclass(frozen=True, kw_only=True)
class Measure(Generic[T]):
    """A measure of an episode: its function, its unit, and how it is shown.

    Attributes:
        function: returns the value of an episode; None or infinite where it has none.
        unit: empty for a number without one, and for a text.
        label: name in the listing of an episode; empty where that leaves it out.
        column: heading in the table All cases of the report (`allCases` in report.js); empty where
            that leaves it out.
        digits: decimals in tables.
        missing: value in conditions for an episode without one. A measure without it is not a
            number: a condition may name it only if it is one of `criterion.TEXTS`.
        worse: end of the values at which an episode is worse; None where neither end is.
        only_with: part of a scenario that the measure needs; empty for every scenario.
        default: value where none is recorded, as in a scenario without the part `only_with`.
    """

    function: Callable[[Any], T]
    unit: str = ""
    label: str = ""
    column: str = ""
    digits: int = 1
    missing: float | None = None
    worse: Literal["low", "high"] | None = None
    only_with: str = ""
    default: Any = None

    @property
    def name(self) -> str:
        """The name in records and conditions."""
        return self.function.__name__

    @property
    def about(self) -> str:
        """The definition, in a sentence without its full stop."""
        return " ".join((inspect.getdoc(self.function) or "").split()).removesuffix(".")

    def __get__(self, measures: object, owner: object = None) -> T:
        """Return the value in the measures of an episode."""
        if isinstance(measures, Measures):
            value: T = measures.value(self.name)
            return value
        return self  # type: ignore[return-value]

    def compute(self, episode: Measures) -> Any:
        """Return the value in an episode; None for an infinite one.

        Args:
            episode: the measures of an episode with its motion.

        Raises:
            UserError: the function of another package fails.
        """
        if self.name in OURS:
            value: Any = self.function(episode)
        elif episode.end.is_error:
            return None
        else:
            try:
                value = self.function(episode)
                value = None if value is None else float(value)
            except Exception as error:
                last = extract_tb(error.__traceback__)[-1]
                raise UserError(
                    f"the measure {self.name!r} failed in {last.filename}, line {last.lineno}: "
                    f"{type(error).__name__}: {error}"
                ) from error
        return None if isinstance(value, float) and not math.isfinite(value) else value


def measure(
    worse: Literal["low", "high"] | None = None, **shown: Any
) -> Callable[[Callable[[Any], T]], Measure[T]]:
    """Declare a measure by its function, whose name ends with the unit.

    Args:
        worse: end of the values at which an episode is worse. In conditions an episode without a
            value counts as harmless, such as cars that never meet: as infinity if low is worse, and
            as 0 if high is worse.
        shown: other attributes of `Measure`.
    """
    missing = {"low": math.inf, "high": 0.0, None: None}[worse]

    def declared(function: Callable[[Any], T]) -> Measure[T]:
        unit = UNITS.get(function.__name__.rpartition("_")[2], "")
        known = {"unit": unit, "missing": missing, "worse": worse}
        return Measure(function=function, **{**known, **shown})

    return declared


class Measures:
    """The measures of one episode (one simulated case), by name.

    `dx_m`, `dv_mps`, `ttc_s`, `drac_mps2` and `merged_first` describe the state at the time t1.
    This is the first step with x_VUT >= 0, or the step of the merge on a road with an acceleration
    lane. These measures are None if the VUT never arrived. In traffic the POV of a definition is
    the car of the mainline that is nearest to the VUT at t1. Severity, clearance, bumper gap,
    braking after M and impact speed take all cars into account.

    A measure is computed when it is first read, or by `compute_all`. Measures that were read from
    a record have no trajectory.

    Attributes:
        trajectory: motion of the episode.
        encounter: how close the VUT came to other cars (`measures_of`).
        values: the computed values, by name.

    Example:
        ```python
        measures = Measures.of(trajectory)
        print(measures.severity, measures.ttc_s)
        ```
    """

    encounter: Encounter = NONE_MET

    def __init__(self, trajectory: Trajectory | None = None, **values: Any) -> None:
        """Take the motion of an episode, or recorded values.

        Args:
            trajectory: the motion; None for recorded values.
            values: values of measures by name.
        """
        self.trajectory: Trajectory = trajectory  # type: ignore[assignment]
        self.values = values

    @classmethod
    def of(cls, trajectory: Trajectory, lines: CentreLines | None = None) -> Measures:
        """Return all measures of an episode.

        Args:
            trajectory: the motion.
            lines: centre lines of the road; without them the clearance before M is not measured.
        """
        (measures,) = measures_of([trajectory], lines)
        measures.compute_all()
        return measures

    def compute_all(self) -> None:
        """Compute all measures that have no value yet."""
        for name in known_measures():
            self.value(name)

    def value(self, name: str) -> Any:
        """Return the value of a measure; None if the episode has none.

        Args:
            name: name of the measure, of this package or of an installed one.
        """
        if name not in self.values:
            known = known_measures()[name]
            computed = known.default if self.trajectory is None else known.compute(self)
            self.values[name] = computed
        return self.values[name]

    def __eq__(self, other: object) -> bool:
        """Return whether all values are the same."""
        if not isinstance(other, Measures):
            return NotImplemented
        return all(self.value(name) == other.value(name) for name in known_measures())

    __hash__ = None  # type: ignore[assignment]

    def __getstate__(self) -> dict[str, Any]:
        """Return the values without the episode."""
        return self.values

    def __setstate__(self, values: dict[str, Any]) -> None:
        """Take the values."""
        Measures.__init__(self, **values)

    @property
    def result(self) -> str:
        """The severity of the episode, or its end if it has no severity."""
        return self.severity or self.end.value

    @property
    def is_close(self) -> bool:
        """Whether the case fails by the paper: the front bumpers are too close at M."""
        return self.score is not None and self.score < FAILURE_SCORE

    @measure()
    def end(self) -> End:
        """Reason of the end: MERGED, TIMEOUT, VUT_ERROR or SIM_ERROR."""
        return self.trajectory.end

    @measure(worse="low", label="score P", digits=0, missing=0.0)
    def score(self) -> float | None:
        """Score P of the paper, never positive. None after an error (VUT_ERROR, SIM_ERROR)."""
        return merge_score(self.trajectory)

    @measure(label="front bumper at M, POV minus VUT", column="Δx at M", missing=math.inf)
    def dx_m(self) -> float | None:
        """Distance of the front bumpers, x_POV - x_VUT."""
        return self._at_m(0)

    @measure(label="speed at M, POV minus VUT", column="dv", missing=0.0)
    def dv_mps(self) -> float | None:
        """Difference of the speeds, v_POV - v_VUT."""
        return self._at_m(1)

    def _at_m(self, column: int) -> float | None:
        """Return the difference of the car at M and the VUT."""
        if self.end is not End.MERGED:
            return None
        last = self.trajectory.motion[-1]
        return float(last[self.trajectory.nearest, column] - last[VUT, column])

    @measure(worse="low", label="time to collision", column="TTC")
    def ttc_s(self) -> float | None:
        """Time to collision of the front bumpers, -dx/dv. None (infinite) unless dx dv < 0."""
        dx, dv = self.dx_m, self.dv_mps
        return None if dx is None or dv is None else time_to_collision(dx, dv)

    @measure(worse="low", label="post-encroachment time", column="PET")
    def pet_s(self) -> float | None:
        """Post-encroachment time: time between the two front bumpers at M (Allen et al., 1978).

        A POV that has not reached M at t1 is assumed to keep its speed. None if it stands.
        """
        return _post_encroachment_time(self.trajectory) if self.end is End.MERGED else None

    @measure(column="time", missing=0.0)
    def t_end_s(self) -> float:
        """Time of the end, or of the merge."""
        return self.trajectory.t_end_s

    @measure()
    def severity(self) -> Severity | None:
        """Class of the motion: contact, conflict, harsh or safe.

        None after an error, and if the VUT neither touched a car nor reached M.
        """
        if self.encounter.row is not None:
            return Severity.CONTACT
        if self.end is not End.MERGED:
            return None
        if self.is_close:
            return Severity.CONFLICT
        return Severity.HARSH if (self.after_brake_mps2 or 0.0) > HARSH_MPS2 else Severity.SAFE

    @measure(worse="low", label="bumper gap at M", column="bumper gap at M")
    def bumper_gap_m(self) -> float | None:
        """Smallest gap between bumpers at M.

        It goes from the front bumper of the car behind to the rear bumper of the car ahead, and is
        negative if the bodies overlap. None without a merge.
        """
        return float(gaps_at_m(self.trajectory)[0].min(initial=math.inf))

    @measure(worse="low", label="smallest gap from M on, or overlap (negative)", column="clearance")
    def clearance_m(self) -> float | None:
        """Smallest gap between bumpers from M on, or minus the depth of an overlap of bodies.

        0 or less with a contact, also with a contact before M. None if the VUT neither touched a
        car nor merged.
        """
        found = self.bumper_gap_m, self.after_gap_m, self.encounter.overlap_m
        return min(value for value in found if value is not None)

    @measure(worse="low", label="smallest clearance before M", column="clearance before M")
    def before_clearance_m(self) -> float | None:
        """Smallest distance of bodies before M, where the lanes run together.

        0 or less if they overlap. None if the VUT never came there.
        """
        return self.encounter.before_m

    @measure(worse="high", label="deceleration to keep 6 m apart")
    def drac_mps2(self) -> float | None:
        """Deceleration rate to avoid a crash: the braking that the car behind needs at t1.

        It is dv^2 / (2 (|dx| - 6)), after Cooper and Ferguson (1976), and 0 if the gap opens. None
        if |dx| < 6 m.
        """
        dx, dv = self.dx_m, self.dv_mps
        if dx is None or dv is None or self.is_close:
            return None
        if dx * dv >= 0:
            return 0.0
        gap = abs(dx) - self.trajectory.case.scenario.dx_crash_m
        return dv * dv / (2 * gap) if gap > 0 else None

    @measure(
        worse="high",
        label="braking that the car behind needs at M",
        column="braking needed at M",
    )
    def brake_after_mps2(self) -> float | None:
        """Braking that the car behind at M needs to avoid a contact with the car ahead.

        It begins after a reaction time of 0.75 s, and the car ahead keeps its speed. None if no
        braking is enough, and without a merge.
        """
        return brake_after_mps2(self.trajectory) if self.end is End.MERGED else None

    @measure(
        worse="high",
        label="hardest braking of the VUT up to M",
        column="VUT brakes",
        default=0.0,
    )
    def vut_max_brake_mps2(self) -> float:
        """Hardest braking of the VUT up to t1, as a positive number."""
        return max(0.0, -float(self.trajectory.a_vut_mps2.min()))

    @measure(
        worse="high",
        label="hardest braking of the POV up to M",
        column="POV brakes",
        default=0.0,
    )
    def pov_max_brake_mps2(self) -> float:
        """Hardest braking of the POV up to t1, as a positive number."""
        return max(0.0, -float(self.trajectory.motion[:, self.trajectory.nearest, 2].min()))

    @measure(
        worse="high",
        label="mean braking of the POV over 1.6 s up to M",
        column="POV brakes (mean of 1.6 s)",
    )
    def pov_sustained_brake_mps2(self) -> float | None:
        """Largest mean braking of the POV over 1.6 s up to t1, or over a shorter episode."""
        return sustained_brake_mps2(self.trajectory.motion[:, self.trajectory.nearest, 1])

    @measure(worse="high", label="loss of speed of the POV up to M", column="POV slows by")
    def pov_slowdown_mps(self) -> float | None:
        """Largest loss of speed of the POV up to t1, compared with its highest speed before."""
        v_mps = self.trajectory.motion[:, self.trajectory.nearest, 1]
        return float((np.maximum.accumulate(v_mps) - v_mps).max())

    @measure(worse="high", label="impact speed", column="impact")
    def impact_speed_mps(self) -> float | None:
        """Relative speed in the plane when bodies first overlap. None without a contact."""
        return self.encounter.impact_mps

    @measure()
    def merged_first(self) -> Literal["VUT", "POV"] | None:
        """Vehicle whose front bumper is ahead at M: VUT or POV."""
        if self.dx_m is None:
            return None
        return "VUT" if self.dx_m < 0 else "POV"

    @measure(worse="low", label="avoidable until")
    def last_avoidable_s(self) -> float | None:
        """Last time from which the VUT could have kept 6 m, if |dx| < 6 m at M.

        The VUT then accelerates or brakes fully by eq. (4). The other cars move as recorded, and
        then keep their last speed. None without such a time, and if |dx| >= 6 m.
        """
        return last_avoidable_s(self.trajectory) if self.is_close else None

    @measure()
    def avoidable(self) -> bool | None:
        """Whether `last_avoidable_s` exists. None if |dx| >= 6 m at M."""
        return self.last_avoidable_s is not None if self.is_close else None

    @measure(worse="high", digits=0, default=0)
    def clipped_steps(self) -> int:
        """Number of steps with an acceleration that was clipped to the limits of the VUT."""
        return self.trajectory.clipped_steps

    @measure()
    def error(self) -> str | None:
        """Message of an error of the controller or of the simulation, also after M."""
        return None if self.trajectory.error is None else as_reason(self.trajectory.error)

    @measure(only_with=TRAFFIC, default=VEHICLES[POV])
    def nearest(self) -> Vehicle:
        """Name of the car that counts as POV in the definitions."""
        return VEHICLES[self.trajectory.nearest]

    @measure(worse="low", label="smallest bumper gap after M", only_with=FOLLOW_UP)
    def after_gap_m(self) -> float | None:
        """Smallest gap between bumpers in the follow-up, 0 or less if bodies touch.

        None without a merge.
        """
        return float(self._after()[0].min(initial=math.inf))

    @measure(worse="low", label="time to collision after M", only_with=FOLLOW_UP)
    def after_ttc_s(self) -> float | None:
        """Lowest time to collision between bumpers in the follow-up, 0 if bodies touch.

        None if no gap closes, and without a merge.
        """
        gap_m, closing_mps = self._after()
        if (gap_m <= 0.0).any():
            return 0.0
        return float(times_to_collision_s(gap_m, closing_mps).min(initial=math.inf))

    @measure(worse="high", label="braking needed after M", only_with=FOLLOW_UP)
    def after_drac_mps2(self) -> float | None:
        """Hardest braking that is needed in the follow-up, dv^2 / (2 gap).

        None if bodies touch, and without a merge.
        """
        if self.after_gap_m is None or self.after_gap_m <= 0.0:
            return None
        gap_m, closing_mps = self._after()
        closes = closing_mps > 0.0
        return float((np.square(closing_mps[closes]) / (2.0 * gap_m[closes])).max(initial=0.0))

    @measure(worse="high", label="hardest braking after M", only_with=FOLLOW_UP)
    def after_brake_mps2(self) -> float | None:
        """Hardest braking that happens in the follow-up.

        It is the braking of cars behind the VUT, and of the VUT if the nearest car is ahead. None
        without a merge.
        """
        after = self.trajectory.after
        if after is None:
            return None
        x_m = after[0, :, 0]
        brakes = x_m < x_m[VUT]
        brakes[VUT] = x_m[self.trajectory.nearest] > x_m[VUT]
        return max(0.0, -float(after[:, brakes, 2].min(initial=0.0)))

    def _after(self) -> tuple[FloatArray, FloatArray]:
        """Return bumper gaps and closing speeds in the follow-up, (T, A - 1); else no rows."""
        after = self.trajectory.after
        rows = self.trajectory.motion[:0] if after is None else after
        return gaps_m(rows, self.trajectory.case.scenario.lengths_m)

    @measure(label="position of the merge", column="merges at", missing=math.inf, only_with=LANE)
    def x_merge_m(self) -> float | None:
        """Position at which the VUT merges from the acceleration lane. None without a merge."""
        merges = self.trajectory.case.scenario.lane_m and self.end is End.MERGED
        return place_of_merge_m(self.trajectory) if merges else None

    @measure(
        label="share of the lane",
        column="share of the lane",
        digits=2,
        missing=math.inf,
        only_with=LANE,
    )
    def lane_share(self) -> float | None:
        """Share of the acceleration lane that the VUT uses before it merges.

        None without a merge.
        """
        lane_m, x_m = self.trajectory.case.scenario.lane_m, self.x_merge_m
        if lane_m is None or x_m is None:
            return None
        return (x_m - lane_m[0]) / (lane_m[1] - lane_m[0])

    @measure(worse="low", label="gap ahead at the merge", only_with=LANE)
    def gap_ahead_m(self) -> float | None:
        """Gap between bumpers to the car ahead at the merge. None without a car or a merge."""
        return self._lane_gap(is_ahead=True)[0]

    @measure(worse="low", label="gap behind at the merge", only_with=LANE)
    def gap_behind_m(self) -> float | None:
        """Gap between bumpers to the car behind at the merge. None without a car or a merge."""
        return self._lane_gap(is_ahead=False)[0]

    @measure(
        worse="low",
        label="time gap ahead at the merge",
        column="time gap ahead",
        digits=2,
        only_with=LANE,
    )
    def time_gap_ahead_s(self) -> float | None:
        """`gap_ahead_m` over the speed of the VUT. None without a gap, or if the VUT stands."""
        return self._lane_gap(is_ahead=True)[1]

    @measure(
        worse="low",
        label="time gap behind at the merge",
        column="time gap behind",
        digits=2,
        only_with=LANE,
    )
    def time_gap_behind_s(self) -> float | None:
        """`gap_behind_m` over the speed of the car behind. None without a gap, or if it stands."""
        return self._lane_gap(is_ahead=False)[1]

    def _lane_gap(self, *, is_ahead: bool) -> tuple[float | None, float | None]:
        """Return the gap to the next car at a merge from a lane, in m and in s."""
        if self.x_merge_m is None:
            return None, None
        x_m, v_mps, _ = np.delete(self.trajectory.motion[-1], VUT, axis=0).T
        gaps, _ = gaps_at_m(self.trajectory)
        gaps[(x_m >= self.x_merge_m) != is_ahead] = math.inf
        nearest = gaps.argmin()
        v_rear_mps = self.trajectory.v_vut_mps[-1] if is_ahead else v_mps[nearest]
        gap_m = float(gaps[nearest])
        return gap_m, gap_m / float(v_rear_mps) if v_rear_mps > 0.0 else None

    @measure(
        worse="high",
        label="time standing on the lane",
        column="stands",
        only_with=LANE,
        default=0.0,
    )
    def stood_s(self) -> float:
        """Time that the VUT stands on the acceleration lane."""
        lane_m = self.trajectory.case.scenario.lane_m
        if lane_m is None or self.end.is_error:
            return 0.0
        x_m, v_mps = self.trajectory.x_vut_m, self.trajectory.v_vut_mps
        return round(DT_S * int(((x_m >= lane_m[0]) & (v_mps < STANDS_MPS)).sum()), 1)


OURS = {name: one for name, one in vars(Measures).items() if isinstance(one, Measure)}
RESERVED = frozenset({"index", "batch", "level", "draw", "margin", "foretold"})
"""Other names of a record."""


def _is_measure(item: object) -> bool:
    return (
        isinstance(item, Measure)
        and (item.name in OURS or item.missing is not None)
        and item.name not in RESERVED
    )


MEASURES: Registry[Measure[Any]] = Registry(
    "merge_sumo.measures",
    "measure",
    OURS,
    accepts=_is_measure,
    contract=(
        "a function with the decorator merge_sumo.metrics.measures.measure and a number "
        f"`missing`, and its name must not be one of {', '.join(sorted(RESERVED))}"
    ),
)


@cache
def known_measures() -> dict[str, Measure[Any]]:
    """Return the measures by name, those of this package first; they stay for a process."""
    return dict(MEASURES)


def recorded_measures(scenario: Scenario) -> dict[str, Measure[Any]]:
    """Return the measures that are recorded in a scenario, by name.

    Args:
        scenario: the scenario.
    """
    parts = {""}
    if scenario.follow_up_s > 0.0:
        parts.add(FOLLOW_UP)
    if scenario.lane_m is not None:
        parts.add(LANE)
    if scenario.vehicles > 2:
        parts.add(TRAFFIC)
    return {name: one for name, one in known_measures().items() if one.only_with in parts}


def measures_of(trajectories: Sequence[Trajectory], lines: CentreLines | None) -> list[Measures]:
    """Return the measures of episodes of one scenario.

    Encounters are computed for all episodes at once, which is faster.

    Args:
        trajectories: the motions.
        lines: centre lines of the road; None for none before M.
    """
    measures = list(map(Measures, trajectories))
    for one, encounter in zip(measures, encounters(trajectories, lines), strict=True):
        if not one.end.is_error:
            one.encounter = encounter
    return measures


def sustained_brake_mps2(v_mps: FloatArray) -> float:
    """Return the largest mean deceleration over 1.6 s, or over a shorter time of speeds, in m/s2.

    Args:
        v_mps: speeds of a vehicle, (T + 1,), in m/s.
    """
    steps = min(SUSTAINED_STEPS, len(v_mps) - 1)
    if steps < 1:
        return 0.0
    return max(0.0, float((v_mps[:-steps] - v_mps[steps:]).max())) / (steps * DT_S)


def _crossing_time_s(x_m: FloatArray, v_mps: FloatArray) -> float | None:
    """Return when a vehicle passed 0; eq. (4) moves it at constant speed within a step."""
    step = int(np.argmax(x_m >= 0.0))
    if x_m[step] < 0.0:
        return None
    if step == 0:
        return 0.0
    return (step - 1) * DT_S + float(-x_m[step - 1] / v_mps[step - 1])


def _post_encroachment_time(trajectory: Trajectory) -> float | None:
    """Return PET at M, or at the place of a merge from a lane, where the VUT may have stood."""
    x_m, v_mps = trajectory.motion[:, trajectory.nearest, :2].T
    t_pov = _crossing_time_s(x_m - place_of_merge_m(trajectory), v_mps)
    if t_pov is None:
        if v_mps[-1] <= 0.0:
            return None
        left_m = place_of_merge_m(trajectory) - float(x_m[-1])
        t_pov = trajectory.t_end_s + left_m / float(v_mps[-1])
    t_vut: float | None = trajectory.t_end_s
    if trajectory.case.scenario.lane_m is None:
        t_vut = _crossing_time_s(trajectory.x_vut_m, trajectory.v_vut_mps)
    assert t_vut is not None, "only called once the VUT has arrived"  # noqa: S101
    return abs(t_pov - t_vut)
