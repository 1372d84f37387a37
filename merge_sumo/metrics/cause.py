"""The cause of a case in words, and the regions of the pool where cases fail.

A vehicle brakes where its speed falls `BRAKED_MPS` below the highest speed before; it begins when
it last had that speed. It accelerates where it does not brake and its speed rises as much.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import message_of
from merge_sumo.printable import sentence
from merge_sumo.scenario.case import Case, FloatArray, coordinates
from merge_sumo.scenario.scenario import AHEAD, BEHIND, DT_S, POV, VEHICLES, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory

BRAKED_MPS = 1.0
"""Change of speed that counts as braking or accelerating; the jitter of a network is smaller."""
ROUNDING_MPS = 1e-6


class Kind(StrEnum):
    """Kinds of failures under the paper's criterion; each of these failures has one kind."""

    STALEMATE = "stalemate"
    SQUEEZE = "squeeze"
    POV_BRAKES = "only the POV brakes"
    LATE_BRAKE = "late brake"
    WEAK_BRAKE = "weak brake"


MEANINGS = {
    Kind.STALEMATE: "both brake, and the VUT begins while a way out is left",
    Kind.SQUEEZE: "neither loses 1 m/s, and both arrive together",
    Kind.POV_BRAKES: "the VUT loses less than 1 m/s, and both arrive together",
    Kind.LATE_BRAKE: "the VUT begins to brake when no way out is left",
    Kind.WEAK_BRAKE: "only the VUT brakes, and begins while a way out is left",
}
"""A way out is full braking or full acceleration that keeps the scenario's limit at M."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """The conduct of both vehicles in an episode.

    Attributes:
        vut_brakes_s: time at which the VUT began to brake; None where it did not.
        pov_brakes_s: the same of the POV.
        vut_accelerates: whether the VUT accelerated.
        pov_accelerates: the same of the POV.
        kind: kind of a failure under the paper's rule, else None.
    """

    vut_brakes_s: float | None
    pov_brakes_s: float | None
    vut_accelerates: bool
    pov_accelerates: bool
    kind: Kind | None


def diagnose(trajectory: Trajectory, measures: Measures) -> Diagnosis:
    """Return which vehicle braked in an episode and which kind of failure it was.

    In traffic the POV is the car that is nearest to the VUT at the end.
    """
    seen = trajectory.with_pov(VEHICLES.index(measures.nearest))
    vut_s, pov_s = _brakes_s(seen.v_vut_mps), _brakes_s(seen.v_pov_mps)
    return Diagnosis(
        vut_s,
        pov_s,
        vut_s is None and _gains(seen.v_vut_mps),
        pov_s is None and _gains(seen.v_pov_mps),
        _kind(vut_s, pov_s, measures.last_avoidable_s) if measures.is_close else None,
    )


def _brakes_s(v_mps: FloatArray) -> float | None:
    """Return when a vehicle of speeds (T + 1,) began to brake; None where it did not."""
    highest_mps = np.maximum.accumulate(v_mps)
    lost = np.flatnonzero(highest_mps - v_mps >= BRAKED_MPS - ROUNDING_MPS)
    if not lost.size:
        return None
    at_highest = np.flatnonzero(v_mps[: lost[0]] >= highest_mps[lost[0]] - ROUNDING_MPS)
    return round(float(at_highest[-1]) * DT_S, 1)


def _gains(v_mps: FloatArray) -> bool:
    """Return whether a vehicle of speeds (T + 1,) became faster by `BRAKED_MPS`."""
    gained_mps = v_mps - np.minimum.accumulate(v_mps)
    return bool(gained_mps.max() >= BRAKED_MPS - ROUNDING_MPS)


def _kind(vut_s: float | None, pov_s: float | None, way_out_until_s: float | None) -> Kind:
    if vut_s is None:
        return Kind.SQUEEZE if pov_s is None else Kind.POV_BRAKES
    if way_out_until_s is None or vut_s > way_out_until_s:
        return Kind.LATE_BRAKE
    return Kind.WEAK_BRAKE if pov_s is None else Kind.STALEMATE


DECIMALS = {"m": 0, "m/s": 1, "s": 2, "rad": 2}
"""Decimals of the bounds of regions, by unit."""
NAMED = {POV: "POV", AHEAD: "car ahead", BEHIND: "car behind"}
MOST_BOXES = 10
"""Leaves of the decision tree of a level."""
FEWEST_FAILURES = 3
"""Failures of the smallest region."""


@dataclass(frozen=True, slots=True)
class FailureBox:
    """A region of the pool where at least half of the cases fail.

    Attributes:
        level: POV level.
        where: the bounds of the region in words.
        indices: the cases inside, by these bounds.
        failures: number of failing cases inside.
    """

    level: int
    where: str
    indices: tuple[int, ...]
    failures: int

    @property
    def cases(self) -> int:
        """Number of cases inside."""
        return len(self.indices)


def _quantities(cases: Sequence[Case], scenario: Scenario) -> dict[tuple[str, str], list[float]]:
    """Return the values of cases of a level by name and unit of each quantity.

    With the coordinates there is the time at which a car would reach M at constant speed: failures
    lie in bands of equal time.
    """
    values = {}
    for row in range(scenario.vehicles):
        if row != VUT:
            due_s = []
            for case in cases:
                x_m, v_mps = case.starts()[row]
                due_s.append(-x_m / v_mps if v_mps > 0.0 else scenario.timeout_s)
            values[f"{NAMED[row]} due at M (at constant speed)", "s"] = due_s
    x, v, *others = coordinates(scenario, (cases[0].level,))
    for coordinate in (v, x, *others):
        own = [coordinate.of(case) or 0.0 for case in cases]
        values[coordinate.name, coordinate.unit] = own
    return values


def failure_boxes(outcomes: Sequence[Outcome], level: int) -> list[FailureBox]:
    """Return where the failures of a level lie, the region with most failures first.

    A small decision tree (scikit-learn, Gini, balanced classes) separates failing from other
    cases. Its leaves in which at least half of the cases fail are the regions; failing siblings
    are joined. The shares are of cases that a sampler chose: they are no probabilities.
    """
    judged = [o for o in outcomes if o.case.level == level and o.margin is not None]
    failed = np.array([o.failed for o in judged], dtype=bool)
    if failed.sum() < FEWEST_FAILURES:
        return []
    from sklearn.tree import DecisionTreeClassifier

    cases = [outcome.case for outcome in judged]
    quantities = _quantities(cases, cases[0].scenario)
    places = np.array(list(quantities.values())).T
    tree = DecisionTreeClassifier(
        max_leaf_nodes=MOST_BOXES,
        min_samples_leaf=FEWEST_FAILURES,
        class_weight="balanced",
        random_state=0,
    ).fit(places, failed)
    boxes = []
    for lows, highs in _failing_leaves(tree.tree_, tree.apply(places), failed):
        words = []
        inside = np.ones(len(judged), dtype=bool)
        for (name, unit), values, low, high in zip(quantities, places.T, lows, highs, strict=True):
            # Rounding may move a case over a bound: the written bound decides.
            least, most = (f"{bound:.{DECIMALS.get(unit, 2)}f}" for bound in (low, high))
            inside &= (values >= float(least)) & (values <= float(most))
            if np.isfinite(low) and np.isfinite(high):
                words.append(f"{name} between {least} and {most} {unit}")
            elif np.isfinite(low):
                words.append(f"{name} above {least} {unit}")
            elif np.isfinite(high):
                words.append(f"{name} below {most} {unit}")
        failures = int(failed[inside].sum())
        if failures >= FEWEST_FAILURES:
            indices = tuple(judged[place].index for place in np.flatnonzero(inside))
            where = " and ".join(words) or "anywhere"
            boxes.append(FailureBox(level, where, indices, failures))
    return sorted(boxes, key=lambda box: -box.failures)


def _failing_leaves(
    tree: Any, leaf: FloatArray, failed: FloatArray
) -> list[tuple[FloatArray, FloatArray]]:
    """Return the lower and upper bounds, (d,), of the failing leaves; failing siblings are one.

    Args:
        tree: nodes as scikit-learn has them; children come after their parent.
        leaf: leaf of each case, (n,).
        failed: whether each case failed, (n,).
    """
    fails = np.zeros(tree.node_count, dtype=bool)
    for node in reversed(range(tree.node_count)):
        left, right = tree.children_left[node], tree.children_right[node]
        if left < 0:
            fails[node] = failed[leaf == node].mean() >= 0.5
        else:
            fails[node] = fails[left] and fails[right]
    found = []
    rest = [(0, np.full(tree.n_features, -np.inf), np.full(tree.n_features, np.inf))]
    while rest:
        node, low, high = rest.pop()
        left, right = tree.children_left[node], tree.children_right[node]
        if fails[node]:
            found.append((low, high))
        elif left >= 0:
            dim, at = tree.feature[node], tree.threshold[node]
            below, above = high.copy(), low.copy()
            below[dim] = above[dim] = at
            rest += [(right, above, high), (left, low, below)]
    return found


def cause(outcome: Outcome, trajectory: Trajectory | None, others: str = "") -> str:
    """Return what happened in a case, and until when a failure could be avoided, in sentences.

    Without the message of an error they have letters, digits and `,.:;` only, as labels of sumo-gui
    need.

    Args:
        outcome: the outcome.
        trajectory: its motion; None where that is lost.
        others: a clause on other drivers that would have avoided the failure.
    """
    sentences = [_course(outcome, trajectory)]
    avoided = [clause for clause in (_way_out(outcome), others) if clause]
    if avoided:
        sentences.append("; ".join(avoided))
    if outcome.is_tested and outcome.measures.error is not None:
        sentences.append("after M an error ends the follow-up")
    return " ".join(map(sentence, sentences))


def heading(outcome: Outcome, trajectory: Trajectory | None) -> str:
    """Return kind, severity and impact of a case without an error, in a few words.

    Args:
        outcome: the outcome.
        trajectory: its motion; None where that is lost.
    """
    found = outcome.measures
    text = found.result.lower()
    if outcome.failed:
        kind = None if trajectory is None else diagnose(trajectory, found).kind
        text = f"{kind or 'failure'}, {text}"
    if found.impact_speed_mps is not None:
        text += f" at a relative speed of {found.impact_speed_mps:.1f} m/s"
    return text


def conflicting_car(found: Measures) -> str:
    """Return the car of the mainline that is nearest to the VUT at the end, in words."""
    return "POV" if found.nearest == VEHICLES[POV] else f"car {found.nearest}"


def _course(outcome: Outcome, trajectory: Trajectory | None) -> str:
    found, at = outcome.measures, f"{outcome.measures.t_end_s:g} s"
    if found.end.is_error:
        return f"{found.end} at {at}: {message_of(outcome)}"
    car, text = conflicting_car(found), f"{heading(outcome, trajectory)}: "
    if trajectory is not None:
        course = diagnose(trajectory, found)
        vut = _conduct(course.vut_brakes_s, course.vut_accelerates)
        pov = _conduct(course.pov_brakes_s, course.pov_accelerates)
        text += f"the VUT {vut}, the {car} {pov}, and "
    if found.end is End.TIMEOUT:
        return text + message_of(outcome)
    reaches = "reaches M"
    if found.lane_share is not None and found.lane_share >= 1.0:
        reaches = "merges where the lane ends"
    elif found.lane_share is not None:
        reaches = f"merges at {found.lane_share:.2f} of the lane"
    side = "ahead of" if found.merged_first == "VUT" else "behind"
    apart = f"{abs(found.dx_m or 0.0):.1f} m {side} that of the {car}"
    return f"{text}the VUT {reaches} at {at}, its front bumper {apart}"


def _conduct(brakes_s: float | None, accelerates: bool) -> str:
    if brakes_s is not None:
        return f"begins to brake at {brakes_s:.1f} s"
    return "accelerates" if accelerates else f"keeps its speed within {BRAKED_MPS:g} m/s"


def _way_out(outcome: Outcome) -> str:
    """Return until when the VUT could keep its distance at M, in a clause."""
    found, scenario = outcome.measures, outcome.case.scenario
    if not outcome.failed or found.avoidable is None:
        return ""
    if found.last_avoidable_s is None:
        kept = f"{scenario.dx_crash_m:g} m at {scenario.place}"
        return f"at no time does full braking or full acceleration of the VUT keep {kept}"
    way_out = "the last way out, full braking or full acceleration of the VUT,"
    return f"{way_out} closes at {found.last_avoidable_s:.1f} s"
