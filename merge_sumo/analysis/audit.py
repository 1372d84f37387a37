"""What a campaign may have missed: a bound by audit cases, valid at any time.

An audit case is uniform in the pool, whatever the campaign has found. It is a *missed failure* if
it fails, or has no verdict, and no failure that earlier batches had found is within the radius of
the FMC. With u_i the share of the pool that would be such a failure before audit case i, y_i = 1
for one, and h(u) = (1 - theta u) / (1 - u),

    prod_i theta^y_i h(u_i)^(1 - y_i),    0 <= theta <= 1,

is a martingale that begins with 1, as u_i follows from what was known before. So is its mean over a
prior of theta, and it ever exceeds 1 / risk with a chance of at most `risk` (Ville's inequality;
Robbins, 1970). h grows with u, and u_i only falls, as balls are added and never taken away; so with
a smaller u in the place of every u_i, the share that is left now, the product is smaller. Every u
at which it exceeds 1 / risk is too large: that bounds the share that is left, at any time, however
the campaign reacts to its audit cases.

Levels take turns. For the pool as a whole, a round of one case at each level without a missed
failure counts as that many cases, since log h is convex; a round with missed failures counts these
alone, as h is at least 1.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

from merge_sumo.system.printable import counted, two_digits
from merge_sumo.values.fmc import radius_for
from merge_sumo.values.score import Outcome

CONFIDENCE: Final = 0.95
NONE_MISSED: Final = 0.7
"""Prior chance that nothing is missed, theta = 0; the rest is uniform in theta. Not tuned."""
LATE: Final = 100
"""Case of the campaign from which audit cases count a second time on their own: what is missed
while the search begins says little of what is left."""
ALL: Final = 0.75
"""Prior weight of all audit cases together; the late ones alone have the rest."""


@dataclass(frozen=True, slots=True)
class AuditCase:
    """An audit case, and whether it is a missed failure."""

    index: int
    level: int
    missed: bool


@dataclass(frozen=True, slots=True)
class MissedShare:
    """A bound on the share of the pool, or of a level, that fails far from all failures found.

    Attributes:
        cases: audit cases.
        missed: missed failures among them.
        at_most: the share is not larger than this.
        confidence: chance that this is right, whenever it is looked at.
    """

    cases: int
    missed: int
    at_most: float
    confidence: float = CONFIDENCE

    @property
    def in_short(self) -> str:
        """Return the bound in a clause."""
        return f"{self.missed} missed in {counted(self.cases, 'audit case')}, at most {self._share}"

    def sentence(self, of: str) -> str:
        """Return the bound for the pool, or for a level, in a sentence without a full stop."""
        return (
            f"{counted(self.missed, 'missed failure')} in {counted(self.cases, 'audit case')}: "
            f"with {self.confidence:.0%} confidence, at most {self._share} of {of} fails farther "
            "than the radius of the FMC from every failure that was found"
        )

    @property
    def _share(self) -> str:
        return f"{two_digits(100.0 * self.at_most)} %"


def audit_cases(outcomes: Iterable[Outcome]) -> list[AuditCase]:
    """Return the audit cases among outcomes, by their marks."""
    return [
        AuditCase(outcome.index, outcome.case.level, _is_missed(outcome))
        for outcome in outcomes
        if outcome.audit is not None
    ]


def _is_missed(outcome: Outcome) -> bool:
    if outcome.score is not None and not outcome.failed:
        return False
    nearest = None if outcome.audit is None else outcome.audit.nearest_failure
    dims = len(outcome.case.scenario.dimensions(outcome.case.level))
    return nearest is None or nearest > radius_for(dims)


def missed_shares(cases: Sequence[AuditCase], levels: Sequence[int]) -> dict[int, MissedShare]:
    """Return the bound for each level that has audit cases."""
    found = {}
    for level in levels:
        own = [case for case in cases if case.level == level]
        if own:
            found[level] = _bound(own, [[case] for case in own])
    return found


def missed_share(cases: Sequence[AuditCase], levels: Sequence[int]) -> MissedShare | None:
    """Return the bound for the pool, in which levels are alike; None without audit cases.

    Cases are in the order of their index, and levels take turns.
    """
    if not cases:
        return None
    turns = len(levels)
    rounds = [cases[first : first + turns] for first in range(0, len(cases), turns)]
    return _bound(cases, [one for one in rounds if len(one) == turns])


def _bound(cases: Sequence[AuditCase], rounds: Sequence[Sequence[AuditCase]]) -> MissedShare:
    counts = []
    for weight, first in ((ALL, 0), (1.0 - ALL, LATE)):
        counted = [one for one in rounds if one[0].index >= first]
        missed = sum(case.missed for one in counted for case in one)
        clean = sum(len(one) for one in counted if not any(case.missed for case in one))
        counts.append((weight, missed, clean))
    missed = sum(case.missed for case in cases)
    return MissedShare(len(cases), missed, share_at_most(tuple(counts), 1.0 - CONFIDENCE))


@lru_cache(maxsize=1024)
def share_at_most(counts: tuple[tuple[float, int, int], ...], risk: float) -> float:
    """Return the smallest share whose capital is 1 / risk: none above it is left.

    Args:
        counts: prior weights, which add up to 1, with missed failures and cases that are none.
        risk: chance of being wrong, at any time.
    """
    goal = math.log(1.0 / risk)
    low, high = 0.0, 1.0
    for _ in range(50):
        middle = (low + high) / 2.0
        logs = [math.log(weight) + _log_capital(middle, *count) for weight, *count in counts]
        if _log_sum(logs) < goal:
            low = middle
        else:
            high = middle
    return high


def _log_capital(share: float, missed: int, clean: int) -> float:
    """Return the logarithm of the mean of theta^missed h(share)^clean over the prior of theta.

    With q = theta share, the integral over theta is an incomplete beta function.
    """
    from scipy.special import betainc, betaln

    safe = -clean * math.log1p(-share)
    a, b = missed + 1.0, clean + 1.0
    inside = max(float(betainc(a, b, share)), 1e-300)
    spread = safe - a * math.log(share) + float(betaln(a, b)) + math.log(inside)
    logs = [math.log(1.0 - NONE_MISSED) + spread]
    if not missed:
        logs.append(math.log(NONE_MISSED) + safe)
    return _log_sum(logs)


def _log_sum(logs: Sequence[float]) -> float:
    most = max(logs)
    return most + math.log(sum(math.exp(one - most) for one in logs))
