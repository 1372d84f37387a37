"""Doubts about the outcomes of a campaign, in sentences."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import message_of
from merge_sumo.printable import counted, printable
from merge_sumo.scenario.scenario import DT_S

CLIPPED_SHARE = 0.01
"""Share of clipped steps above which a note says so."""


def doubts(outcomes: Sequence[Outcome], vain: Mapping[str, int]) -> list[str]:
    """Return sentences on doubts about a campaign; none for most.

    Args:
        outcomes: outcomes of a campaign.
        vain: number of cases by command without an effect.
    """
    return [*_clipped(outcomes), *late_errors(outcomes), *in_vain(vain)]


def late_errors(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield a sentence on cases with an error after M, if there are any; they have a verdict.

    Args:
        outcomes: outcomes of a campaign.
    """
    wrong = [o for o in outcomes if o.is_tested and o.measures.error is not None]
    if wrong:
        first = f"the first in case {wrong[0].index}: {message_of(wrong[0])}"
        yield f"in {counted(len(wrong), 'case')} an error ends the follow-up, {first}"


def in_vain(cases: Mapping[str, int]) -> list[str]:
    """Return a sentence on commands without an effect, or no sentence.

    Args:
        cases: number of cases by command.
    """
    listed = ", ".join(f"{printable(name)} in {counted(n, 'case')}" for name, n in cases.items())
    return [f"commands without effect here: {listed}"] if cases else []


def _clipped(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Yield in how many steps a VUT asked for more than its limits, if that is often."""
    clipped = sum(outcome.measures.clipped_steps for outcome in outcomes)
    steps = sum(round(outcome.measures.t_end_s / DT_S) for outcome in outcomes)
    if clipped > CLIPPED_SHARE * steps:
        scenario = outcomes[0].case.scenario
        yield (
            f"accelerations were clipped: in {clipped} of {steps} steps the VUT commanded more "
            f"than the limits, {scenario.a_min_mps2:g} to {scenario.a_max_mps2:g} m/s2; check the "
            "unit and the sign of its accelerations"
        )
