"""How well a campaign's cases were predicted, and where its twin expects failures."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Final

import numpy as np

from merge_sumo.campaigns.run import Run
from merge_sumo.drivers.policies import policies_of
from merge_sumo.engine.povs import Povs
from merge_sumo.errors import UserError
from merge_sumo.road.centre_lines import centre_lines
from merge_sumo.road.corridor import Corridor
from merge_sumo.samplers.prediction_skill import compressed
from merge_sumo.twin.twin import Twin
from merge_sumo.values.case import FloatArray, Pool
from merge_sumo.values.scenario import DX_CRASH_M
from merge_sumo.values.score import Outcome

LAST: Final = 200
"""Cases of which it is said how well they were predicted,"""
LIKELY: Final = 0.5
"""and what chance of failing is a likely one."""
MOST_CASES: Final = 1000
"""Cases, the last ones, that the twin of a report learns from."""


def has_predictions(outcomes: Sequence[Outcome]) -> bool:
    """Return whether anything was predicted of some of the cases."""
    return any(outcome.prediction is not None for outcome in outcomes)


def off_m(outcome: Outcome) -> float | None:
    """Return how many metres the predicted gap was off; None where there was none to compare."""
    if outcome.prediction is None or outcome.measures.score is None:
        return None
    said, came = outcome.prediction.median_dx_m, outcome.signed_gap_m
    return None if said is None or came is None else abs(said - came)


def surprises(outcomes: Sequence[Outcome], limit_m: float) -> list[Outcome]:
    """Return the cases that were predicted, those that came most otherwise first.

    A metre counts more where the gap is small, and a case in which the VUT never arrived, or was
    predicted not to, counts as one with a large gap.
    """

    def surprise(outcome: Outcome) -> float:
        assert outcome.prediction is not None, "only these are asked"  # noqa: S101
        gaps = np.array([outcome.prediction.median_dx_m, outcome.signed_gap_m], dtype=np.float64)
        return abs(float(np.diff(compressed(gaps, limit_m))[0]))

    told = [o for o in outcomes if o.prediction is not None and o.measures.score is not None]
    return sorted(told, key=lambda o: (-surprise(o), o.index))


def prediction_in_words(outcomes: Sequence[Outcome]) -> str | None:
    """Return how well the last cases were predicted; None where none was."""
    last = [outcome for outcome in outcomes if outcome.prediction is not None][-LAST:]
    off = [gap for outcome in last if (gap := off_m(outcome)) is not None]
    if not off:
        return None
    likely = [o for o in last if o.prediction is not None and o.prediction.p_fail >= LIKELY]
    failed = sum(outcome.failed for outcome in likely)
    middle, most = np.quantile(off, (0.5, 0.9)).tolist()
    words = f"In half of the last {len(last)} cases the error was below {_metres(middle)}, and in "
    words += f"nine of ten below {_metres(most)}."
    if likely:
        words += f" Of {len(likely)} that were given a chance of failing of {LIKELY:.0%} or more, "
        words += f"{failed} failed."
    return words


def _metres(length_m: float) -> str:
    """Return a length that is rounded up, in centimetres or metres."""
    return f"{max(math.ceil(100.0 * length_m), 1)} cm" if length_m < 1.0 else f"{length_m:.1f} m"


class Expected:
    """The twin of a run that has ended: where it expects failures."""

    def __init__(self, run: Run, levels: Sequence[int], road: Corridor) -> None:
        """Learn from the motions of a run; raises `UserError` where they or policies are gone."""
        povs = Povs(policies=policies_of(run.scenario))
        if povs.sha256() != run.settings.get("policies_sha256"):
            raise UserError("the run had other drivers than those that are here")
        speed = run.settings.get("v_vut0_mps")
        if type(speed) not in (int, float, type(None)):
            raise UserError("the speed with which the VUT began is no number")
        most_mps = run.scenario.v_start_max_mps
        if speed is not None and not 0.0 <= speed <= most_mps:
            raise UserError(f"the VUT began with {speed} m/s, which no campaign of ours has")
        pool = Pool(
            levels=tuple(levels),
            v_vut0_mps=None if speed is None else float(speed),
            scenario=run.scenario,
        )
        criterion = run.criterion
        self._limit_m = run.scenario.dx_crash_m if criterion.is_papers else DX_CRASH_M
        self._twin = Twin(pool, povs, 0, criterion=criterion, lines=centre_lines(road))
        last = run.outcomes[-MOST_CASES:]
        self._twin.tell(last, {o.index: run.trajectory(o.index).motion for o in last})

    def nearness(self, points: FloatArray, level: int) -> FloatArray | None:
        """Return how near gaps are expected at points, (n, d), as (n,).

        1 where the gap is 0, 0.5 at the limit of a failure, 0 from twice the limit on, as a mean
        over the members. None where cases of the level cannot be played.
        """
        from threadpoolctl import threadpool_limits

        if not self._twin.can_predict(level):
            return None
        with threadpool_limits(1):
            gaps_m = np.concatenate(
                [
                    self._twin.predict(level, part)
                    for part in np.array_split(points, len(points) // MOST_CASES + 1)
                ],
                axis=-1,
            )
        far = np.nan_to_num(np.abs(gaps_m), nan=np.inf) / (2.0 * self._limit_m)
        return np.asarray(np.clip(1.0 - far, 0.0, 1.0).mean(axis=(0, 1)), dtype=np.float64)
