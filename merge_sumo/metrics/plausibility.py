"""Doubts about the outcomes of a campaign, in sentences."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence

from merge_sumo.metrics.criterion import CRITERIA, Criterion, condition_of, values_of
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.summary import message_of
from merge_sumo.printable import counted, printable
from merge_sumo.scenario.scenario import DT_S

KMH_PER_MPS = 3.6
CLIPPED_SHARE = 0.01
"""Share of clipped steps above which a note says so."""
MOSTLY_CLIPPED = 0.5
"""Share of clipped steps above which a headline says so: the limits drove, and not the VUT."""
_THRESHOLD = re.compile(r"(\w+)\s*(?:<=?|>=?)\s*(-?\d+(?:\.\d+)?(?:e[-+]?\d+)?)(?![\w.])")
"""A measure, and the number that it is compared with."""


def doubts(outcomes: Sequence[Outcome], criterion: Criterion, vain: Mapping[str, int]) -> list[str]:
    """Return sentences on doubts about a campaign; none for most.

    Args:
        outcomes: outcomes of a campaign.
        criterion: its failure criterion. Where all cases have the same verdict, a threshold in
            another unit or of the other sign is suggested if it would tell cases apart.
        vain: number of cases by command without an effect.
    """
    clipped = _clipped(outcomes, CLIPPED_SHARE)
    often = [] if clipped is None or mostly_clipped(outcomes) else [clipped]
    return [*often, *late_errors(outcomes), *_one_verdict(outcomes, criterion), *in_vain(vain)]


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
    return [f"commanded in vain, because it changes nothing here: {listed}"] if cases else []


def mostly_clipped(outcomes: Sequence[Outcome]) -> str | None:
    """Return a sentence on a VUT that drove at its limits in most steps; None for others.

    Args:
        outcomes: outcomes of a campaign.
    """
    clipped = _clipped(outcomes, MOSTLY_CLIPPED)
    return clipped and f"not driven as asked: {clipped}; check the unit and the sign of its answers"


def _clipped(outcomes: Sequence[Outcome], share: float) -> str | None:
    """Return in how many steps a VUT asked for more than its limits; None up to a share of them."""
    clipped = sum(outcome.measures.clipped_steps for outcome in outcomes)
    steps = sum(round(outcome.measures.t_end_s / DT_S) for outcome in outcomes)
    if clipped <= share * steps:
        return None
    scenario = outcomes[0].case.scenario
    return (
        f"in {clipped} of {steps} steps the VUT asks for an acceleration outside "
        f"{scenario.a_min_mps2:g} to {scenario.a_max_mps2:g} m/s2, which is clipped"
    )


def _one_verdict(outcomes: Sequence[Outcome], criterion: Criterion) -> Iterator[str]:
    """Yield a similar criterion that tells cases apart, where the criterion does not."""
    judged = [outcome for outcome in outcomes if outcome.margin is not None]
    failures = sum(outcome.failed for outcome in judged)
    is_own = criterion.require is None and criterion.fail_when not in CRITERIA
    if not is_own or 0 < failures < len(judged):
        return
    for text, why in _with_other_thresholds(criterion.condition):
        other = condition_of(text)
        met = sum(other.margin(values_of(outcome.measures)) < 0.0 for outcome in judged)
        if 0 < met < len(judged):
            every = "every case fails" if failures else "no case fails"
            yield (
                f"{every} under {criterion.condition}; with {text} ({why}) {met} of "
                f"{counted(len(judged), 'case')} would"
            )
            return


def _with_other_thresholds(condition: str) -> Iterator[tuple[str, str]]:
    """Yield a condition with a threshold in another unit or of the other sign, and its meaning."""
    for found in _THRESHOLD.finditer(condition):
        name, number = found[1], float(found[2])
        others = [(-number, "the other sign")] if number else []
        if name.endswith("_mps"):
            others.insert(0, (number / KMH_PER_MPS, f"{number:g} km/h"))
        for other, why in others:
            yield f"{condition[: found.start(2)]}{other:.3g}{condition[found.end(2) :]}", why
