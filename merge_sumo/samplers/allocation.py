"""How many cases of a batch each POV level gets (Wang et al., section V-D)."""

from __future__ import annotations

from collections.abc import Mapping

from merge_sumo.metrics.outcome import Outcome


def even_shares(proposed: Mapping[int, int], n: int) -> dict[int, int]:
    """Share `n` cases out evenly; remainders go to the levels with the fewest cases `proposed`."""
    return whole_shares(dict.fromkeys(proposed, 1.0), proposed, n)


def whole_shares(
    weights: Mapping[int, float], proposed: Mapping[int, int], n: int
) -> dict[int, int]:
    """Share `n` out in proportion to positive weights, in whole numbers that add up to `n`.

    Each level gets one case first; if `n` does not suffice, the levels with the fewest cases
    `proposed` come first. The rest follows the largest remainders.
    """
    by_need = sorted(weights, key=lambda level: (proposed[level], level))
    shares = {level: 1 if rank < n else 0 for rank, level in enumerate(by_need)}
    total = sum(weights.values())
    quota = {level: n * weight / total for level, weight in weights.items()}
    for _ in range(n - sum(shares.values())):
        lacking = max(by_need, key=lambda level: quota[level] - shares[level])
        shares[lacking] += 1
    return {level: shares[level] for level in sorted(shares)}


def last_failure_share(outcomes: list[Outcome], level: int) -> float:
    """Return U(i, k): the share of failures in the last batch that had cases at level k."""
    of_level = [o for o in outcomes if o.case.level == level]
    if not of_level:
        return 0.0
    last = max(o.batch for o in of_level)
    verdicts = [o.failed for o in of_level if o.batch == last]
    return sum(verdicts) / len(verdicts)
