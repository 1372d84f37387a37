"""The verdict on one episode: the score P and named safety measures (Wang et al., section V-A).

P = MU_CRASH I_crash + MU_SAFETY P_safety + MU_TASK P_task is never positive, and P < -500 exactly
when the front bumpers are within 6 m as the VUT reaches M, which the paper calls a crash; bodies
need not touch then (`severity.py`). A surrogate must be able to learn P, so it falls smoothly over
tens of metres towards that limit, jumps little there, and goes on falling beyond it.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cache
from typing import Any, Final, Literal, NamedTuple, get_type_hints

import numpy as np

from merge_sumo.metrics.bodies import CentreLines, closest_before_m
from merge_sumo.metrics.measures import (
    MEASURES,
    OURS,
    Further,
    Measure,
    further_measures,
    further_of,
    with_values,
)
from merge_sumo.metrics.merge import (
    Severity,
    brake_after_mps2,
    braked_after_mps2,
    closest_after_m,
    followed_up,
    last_avoidable_s,
    neighbours,
    on_lane,
    place_of_merge_m,
    severity_of,
)
from merge_sumo.metrics.prediction import Prediction
from merge_sumo.records import convert, decode, record_type, to_plain
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.scenario import DT_S, POV, VEHICLES, VUT, Scenario, Vehicle
from merge_sumo.scenario.trajectory import End, Trajectory, as_reason

FAILURE_SCORE: Final = -500.0
"""lambda: a case fails by the paper's criterion when its score is below."""

# The bounds that make "P < -500" and the paper's crash the same: without one P_safety and
# P_task are at least -1, so P >= -495; with one P_safety is at most -1, so P <= -560.
MU_CRASH: Final = -110.0
MU_SAFETY: Final = 450.0
MU_TASK: Final = 45.0
GAP_SCALE_M: Final = 15.0
"""Length over which P_safety decays with the gap; tens of metres, so that a surrogate sees it."""
SUSTAINED_STEPS: Final = 16
"""Steps over which braking counts as sustained: 1.6 s, as in published braking of drivers."""
TTC_SHARE: Final = 1.0 / 9.0
"""Part of P_safety that a short time to collision can cost; the gap has the rest."""


MEASURED: Final = frozenset(measure.name for measure in OURS if measure.of is None)
"""Measures that are fields of `Measures`."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Measures:
    """Named measures of one episode, with the verdict first.

    dx, dv, TTC, DRAC and the order of merging are taken at t1, the first step with x_VUT >= 0, and
    are None when the VUT never arrived. In traffic they are those of the car of the mainline that
    is nearest to the VUT at the end: it takes the POV's place. What bodies do (severity, clearance,
    bumper gap, braking after M, impact speed) is that of all cars.

    `measures.py` says what each is; `further` holds those with a function of their own. A kind of
    scenario leaves out what it does not measure.
    """

    end: End
    score: float | None = None
    dx_m: float | None = None
    dv_mps: float | None = None
    ttc_s: float | None = None
    pet_s: float | None = None
    t_end_s: float
    severity: Severity | None = None
    bumper_gap_m: float | None = None
    clearance_m: float | None = None
    before_clearance_m: float | None = None
    drac_mps2: float | None = None
    brake_after_mps2: float | None = None
    vut_max_brake_mps2: float = 0.0
    pov_max_brake_mps2: float = 0.0
    pov_sustained_brake_mps2: float | None = None
    pov_slowdown_mps: float | None = None
    impact_speed_mps: float | None = None
    merged_first: Literal["VUT", "POV"] | None = None
    last_avoidable_s: float | None = None
    avoidable: bool | None = None
    clipped_steps: int = 0
    error: str | None = None
    nearest: Vehicle = VEHICLES[POV]
    after_gap_m: float | None = None
    after_ttc_s: float | None = None
    after_drac_mps2: float | None = None
    after_brake_mps2: float | None = None
    x_merge_m: float | None = None
    lane_share: float | None = None
    gap_ahead_m: float | None = None
    gap_behind_m: float | None = None
    time_gap_ahead_s: float | None = None
    time_gap_behind_s: float | None = None
    stood_s: float = 0.0
    further: Further = ()

    @classmethod
    def of(cls, trajectory: Trajectory, **values: Any) -> Measures:
        """Return the measures of an episode: those that every kind of scenario has, and `values`.

        After an error a verdict says nothing, and `values` are left out.
        """
        v_pov_mps = trajectory.motion[:, trajectory.nearest, 1]
        hardest_mps2 = [max(0.0, -a) for a in trajectory.motion[:, :, 2].min(axis=0).tolist()]
        common: dict[str, Any] = {
            "end": trajectory.end,
            "t_end_s": trajectory.t_end_s,
            "vut_max_brake_mps2": hardest_mps2[VUT],
            "pov_max_brake_mps2": hardest_mps2[trajectory.nearest],
            "pov_sustained_brake_mps2": sustained_brake_mps2(v_pov_mps),
            "pov_slowdown_mps": float((np.maximum.accumulate(v_pov_mps) - v_pov_mps).max()),
            "clipped_steps": trajectory.clipped_steps,
            "error": None if trajectory.error is None else as_reason(trajectory.error),
            "nearest": VEHICLES[trajectory.nearest],
        }
        return cls(**common) if trajectory.end.is_error else cls(**common | values)

    def value(self, name: str) -> Any:
        """Return the value of a measure, of this package or further; None where it has none."""
        return getattr(self, name) if name in MEASURED else dict(self.further).get(name)

    @property
    def became(self) -> str:
        """What became of the episode in a word: its severity, or its end where it has none."""
        return self.severity or self.end.value

    @property
    def is_close(self) -> bool:
        """Whether the front bumpers were nearer at M than the paper allows: its rule of a crash."""
        return self.score is not None and self.score < FAILURE_SCORE


class CaseVerdict(NamedTuple):
    """The verdict on an episode, without its measures.

    Attributes:
        margin: how far it is from failing, below 0 where it fails; None after an error.
        is_tested: whether the episode says something of the VUT: see `Outcome.is_tested`.
    """

    margin: float | None
    is_tested: bool

    @property
    def failed(self) -> bool:
        """Whether the margin is below 0."""
        return self.margin is not None and self.margin < 0.0


@dataclass(frozen=True, slots=True)
class Outcome:
    """A case that was run: its place in the campaign, its measures, and what was predicted of it.

    Attributes:
        index: its place in the campaign.
        batch: the batch in which it ran.
        case: the case.
        measures: what was measured.
        prediction: what was predicted of it; None without a prediction.
        margin: how far it is from failing under the campaign's criterion, below 0 where it fails,
            without a unit; by default that of the score P; None after an error.
    """

    index: int
    batch: int
    case: Case
    measures: Measures
    prediction: Prediction | None = None
    margin: float | None = None

    def __post_init__(self) -> None:
        """Take the margin of the score where no other is given."""
        if self.margin is None:
            object.__setattr__(self, "margin", margin_of(self.measures.score))

    @property
    def failed(self) -> bool:
        """Whether this case is a failure of the VUT: its margin is below 0."""
        return self.margin is not None and self.margin < 0.0

    @property
    def is_by_score(self) -> bool:
        """Whether the margin is that of the score."""
        return self.margin == margin_of(self.measures.score)

    @property
    def is_tested(self) -> bool:
        """Whether this case says something of the VUT: it reached the merge point, or failed."""
        return self.measures.end.is_tested or self.failed

    @property
    def verdict(self) -> CaseVerdict:
        """The verdict alone."""
        return CaseVerdict(self.margin, self.is_tested)

    @property
    def signed_gap(self) -> float | None:
        """The gap at M in units of the scenario's limit: within 1 the case fails.

        Under another criterion than the paper's it is what stands for it: 1 + m at a margin m of 0
        or more, and 1 / (1 - m) below. Negative where the VUT goes first; None after an error, and
        where the paper's criterion has no gap.
        """
        dx_m, margin = self.measures.dx_m, self.margin
        if margin is None or self.is_by_score:
            return None if dx_m is None else dx_m / self.case.scenario.dx_crash_m
        gap = 1.0 + margin if margin >= 0.0 else 1.0 / (1.0 - margin)
        return -gap if dx_m is not None and dx_m < 0.0 else gap

    def to_record(self) -> dict[str, Any]:
        """Return the flat, JSON-ready record that `outcomes.jsonl` holds, units in the names."""
        case_names, measure_names, _ = record_fields(self.case.scenario)
        record: dict[str, Any] = {"index": self.index, "batch": self.batch}
        record |= {name: getattr(self.case, name) for name in case_names}
        if self.case.draw:
            record["draw"] = self.case.draw
        record |= {name: getattr(self.measures, name) for name in measure_names}
        record |= {name: self.measures.value(name) for name in further_measures()}
        if not self.is_by_score:
            record["margin"] = self.margin
        if self.prediction is not None:
            record["foretold"] = to_plain(self.prediction)
        return record

    @classmethod
    def from_json(cls, line: bytes | str, scenario: Scenario) -> Outcome:
        """Return the outcome of a line of `outcomes.jsonl`; `UserError` where it is none."""
        case_names, measure_names, flat = record_fields(scenario)
        known = convert(decode(line), flat)
        coordinates = {name: getattr(known, name) for name in case_names}
        case = Case(**coordinates, draw=known.draw, scenario=scenario)
        measures = Measures(
            **{name: getattr(known, name) for name in measure_names},
            further=with_values({name: getattr(known, name) for name in further_measures()}),
        )
        return cls(known.index, known.batch, case, measures, known.foretold, known.margin)


FOLLOWED_UP: Final = ("after_gap_m", "after_ttc_s", "after_drac_mps2", "after_brake_mps2")
"""Measures of the follow-up."""
ON_LANE: Final = (
    *("x_merge_m", "lane_share", "gap_ahead_m", "gap_behind_m"),
    *("time_gap_ahead_s", "time_gap_behind_s", "stood_s"),
)
"""Measures of a merge from an acceleration lane."""


def measures_in(scenario: Scenario) -> list[Measure]:
    """Return the measures that episodes of a scenario may have, those of a lane only with one."""
    left_out = () if scenario.lane_m else ON_LANE
    return [measure for measure in MEASURES.values() if measure.name not in left_out]


def record_fields(scenario: Scenario) -> tuple[tuple[str, ...], tuple[str, ...], Any]:
    """Return the fields of a case and of measures that a record has, and the type of the record."""
    left_out = {
        *(() if scenario.vehicles > 2 else ("nearest",)),
        *(() if scenario.follow_up_s > 0.0 else FOLLOWED_UP),
        *(ON_LANE if scenario.lane_m is None else ()),
    }
    return _record_fields(scenario.case_fields, frozenset(left_out))


@cache
def _record_fields(
    case_fields: tuple[str, ...], left_out: frozenset[str]
) -> tuple[tuple[str, ...], tuple[str, ...], Any]:
    case_names = ("level", *case_fields)
    not_fields = {"further", *left_out}
    measure_names = tuple(name for name in Measures.__slots__ if name not in not_fields)
    types = get_type_hints(Case) | get_type_hints(Measures) | {"index": int, "batch": int}
    names = [name for name in measure_names if name not in FOLLOWED_UP]
    required = [(name, types[name]) for name in ("index", "batch", *case_names, *names)]
    further = [(name, float | None, None) for name in further_measures()]
    optional = [
        *((name, types[name], None) for name in measure_names if name in FOLLOWED_UP),
        *further,
        ("draw", int, 0),
        ("margin", float | None, None),
        ("foretold", Prediction | None, None),
    ]
    return case_names, measure_names, record_type("outcome", [*required, *optional])


def margin_of(score: float | None) -> float | None:
    """Return the margin of a score P: how far it is above lambda, in units of that."""
    return None if score is None else (score - FAILURE_SCORE) / abs(FAILURE_SCORE)


def is_close(trajectory: Trajectory) -> bool:
    """Return whether the VUT arrived at M with |dx| < 6 m: the paper's rule of a crash."""
    x_m, crash_m = trajectory.motion[-1, :, 0], trajectory.case.scenario.dx_crash_m
    near = bool(abs(x_m[trajectory.nearest] - x_m[VUT]) < crash_m)
    return trajectory.end is End.MERGED and near


def measure(
    trajectory: Trajectory,
    lines: CentreLines | None = None,
    *,
    avoidability: bool = True,
    further: Collection[str] | None = None,
) -> Measures:
    """Return the verdict and the measures of an episode.

    Args:
        trajectory: what happened.
        lines: centre lines of the road; without them bodies are looked at from M on.
        avoidability: whether `last_avoidable_s` is computed, which takes most of the time.
        further: names of the further measures that are taken; all by default.
    """
    return measure_all([trajectory], lines, avoidability=avoidability, further=further)[0]


def measure_all(
    trajectories: Sequence[Trajectory],
    lines: CentreLines | None,
    *,
    avoidability: bool = True,
    further: Collection[str] | None = None,
) -> list[Measures]:
    """Return the same of episodes of one scenario, which takes less time than one by one."""
    if not trajectories:
        return []
    measured = measure_merges(trajectories, lines, avoidability=avoidability)
    if not further_measures():
        return list(measured)
    return [
        replace(measures, further=further_of(trajectory, lines, further))
        for measures, trajectory in zip(measured, trajectories, strict=True)
    ]


def merge_score(trajectory: Trajectory) -> float | None:
    """Return the score P of a merge; None after an error."""
    if trajectory.end.is_error:
        return None
    dx = ttc = None
    if trajectory.end.is_tested:
        pov, vut = trajectory.motion[-1, [trajectory.nearest, VUT], :2].tolist()
        dx = pov[0] - vut[0]
        ttc = time_to_collision(dx, pov[1] - vut[1])
    return _score(trajectory, dx, ttc, close=is_close(trajectory))


def measure_merges(
    trajectories: Sequence[Trajectory], lines: CentreLines | None, *, avoidability: bool = True
) -> list[Measures]:
    """Return the verdict and the measures of merges: see `measure`."""
    before_m = [math.inf] * len(trajectories)
    if lines is not None:
        before_m = closest_before_m(trajectories, lines)
    pairs = zip(trajectories, before_m, strict=True)
    return [_measure(*pair, avoidability=avoidability) for pair in pairs]


def _measure(trajectory: Trajectory, before_m: float, *, avoidability: bool) -> Measures:
    pair = trajectory.facing(trajectory.nearest)
    (x_pov, v_pov, _), (x_vut, v_vut, _) = pair.motion[-1].tolist()
    end, close = trajectory.end, is_close(trajectory)
    dx = dv = ttc = pet = drac = avoidable = last_avoidable = None
    first: Literal["VUT", "POV"] | None = None
    if end.is_tested:
        dx, dv = x_pov - x_vut, v_pov - v_vut
        ttc = time_to_collision(dx, dv)
        pet = _post_encroachment_time(pair)
        first = "VUT" if dx < 0 else "POV"
        if close and avoidability:
            last_avoidable = last_avoidable_s(trajectory)
            avoidable = last_avoidable is not None
        if not close:
            gap = abs(dx) - trajectory.case.scenario.dx_crash_m
            drac = 0.0 if dx * dv >= 0 else (dv * dv / (2 * gap) if gap > 0 else None)
    clearance, impact = closest_after_m(trajectory)
    brake, braked = brake_after_mps2(trajectory), braked_after_mps2(trajectory)
    severity = severity_of(end, clearance, is_close=close, brake_mps2=braked)
    followed: tuple[float | None, ...] = followed_up(trajectory) or (None, None, None)
    return Measures.of(
        trajectory,
        severity=severity,
        score=_score(trajectory, dx, ttc, close=close),
        dx_m=dx,
        bumper_gap_m=min((gap for gap, _ in neighbours(trajectory)), default=None),
        clearance_m=_finite(clearance),
        before_clearance_m=_finite(before_m),
        dv_mps=dv,
        ttc_s=ttc,
        pet_s=pet,
        drac_mps2=drac,
        brake_after_mps2=_finite(brake) if end is End.MERGED else None,
        impact_speed_mps=impact,
        merged_first=first,
        last_avoidable_s=last_avoidable,
        avoidable=avoidable,
        after_gap_m=followed[0],
        after_ttc_s=_finite(followed[1]),
        after_drac_mps2=_finite(followed[2]),
        after_brake_mps2=braked,
        **on_lane(trajectory),
    )


def _finite(value: float | None) -> float | None:
    return value if value is not None and math.isfinite(value) else None


def sustained_brake_mps2(v_mps: FloatArray) -> float:
    """Return the largest mean deceleration over 1.6 s of speeds, (T + 1,), or over all of them."""
    steps = min(SUSTAINED_STEPS, len(v_mps) - 1)
    if steps < 1:
        return 0.0
    return max(0.0, float((v_mps[:-steps] - v_mps[steps:]).max())) / (steps * DT_S)


def time_to_collision(dx_m: float, dv_mps: float) -> float | None:
    """Return TTC = -dx/dv in seconds where the gap closes (dx dv < 0), else None (section VI-C)."""
    return -dx_m / dv_mps if dx_m * dv_mps < 0 else None


def _score(trajectory: Trajectory, dx: float | None, ttc: float | None, *, close: bool) -> float:
    p_safety = 0.0
    if dx is not None:
        scenario = trajectory.case.scenario
        overlap = scenario.dx_crash_m - abs(dx)
        if close:
            p_safety = -1.0 - overlap / scenario.dx_crash_m
        else:
            short_ttc = 0.0 if ttc is None else max(0.0, 1.0 - ttc / scenario.ttc_min_s)
            near = math.exp(overlap / GAP_SCALE_M)
            p_safety = -(1.0 - TTC_SHARE) * near - TTC_SHARE * short_ttc
    crash = MU_CRASH if close else 0.0
    return crash + MU_SAFETY * p_safety + MU_TASK * _task(trajectory)


def _task(trajectory: Trajectory) -> float:
    """Return P_task in [-1, 0]: a slow ramp, a final speed off the highway's, harshness, no end."""
    v_vut, scenario = trajectory.v_vut_mps, trajectory.case.scenario
    v_end = float(v_vut[-1])
    steps = len(v_vut)
    # The sums are a third of the time of `mean`, and the same to the last bit.
    slow = float(np.add.reduce(np.maximum(scenario.v_min_mps - v_vut, 0.0)) / steps)
    slow /= scenario.v_min_mps
    off_range = max(scenario.v_hw_min_mps - v_end, v_end - scenario.v_hw_max_mps, 0.0)
    off_range = min(off_range / scenario.v_hw_min_mps, 1.0)
    hardest = max(-scenario.a_min_mps2, scenario.a_max_mps2)
    harsh = float(np.add.reduce(np.square(trajectory.a_vut_mps2)) / steps) / hardest**2
    return -(slow + off_range + harsh + (trajectory.end is End.TIMEOUT)) / 4.0


def _crossing_time_s(x: FloatArray, v: FloatArray) -> float | None:
    """Return when a vehicle passed 0; eq. (4) moves it at constant speed within a step."""
    step = int(np.argmax(x >= 0.0))
    if x[step] < 0.0:
        return None
    if step == 0:
        return 0.0
    return (step - 1) * DT_S + float(-x[step - 1] / v[step - 1])


def _post_encroachment_time(trajectory: Trajectory) -> float | None:
    """Return PET at M, or at the place of a merge from a lane, where the VUT may have stood."""
    place_m = place_of_merge_m(trajectory)
    x_pov_m, x_vut_m = trajectory.x_pov_m - place_m, trajectory.x_vut_m
    on_road = trajectory.case.scenario.lane_m is not None
    t_vut = trajectory.t_end_s if on_road else _crossing_time_s(x_vut_m, trajectory.v_vut_mps)
    t_pov = _crossing_time_s(x_pov_m, trajectory.v_pov_mps)
    if t_pov is None:
        v_end = float(trajectory.v_pov_mps[-1])
        if v_end <= 0.0:
            return None
        t_pov = trajectory.t_end_s - float(x_pov_m[-1]) / v_end
    assert t_vut is not None, "only called once the VUT has arrived"  # noqa: S101
    return abs(t_pov - t_vut)
