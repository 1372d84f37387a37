"""How a batch is shared out over the POV levels."""

from __future__ import annotations

from hypothesis import given, settings
from hypothesis import strategies as st

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.samplers.allocation import even_shares, last_failure_share, whole_shares
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End


@st.composite
def weights_and_told(draw) -> tuple[dict[int, float], dict[int, int]]:
    levels = draw(st.lists(st.sampled_from([0, 1, 2]), min_size=1, unique=True))
    weights = {level: draw(st.floats(1e-3, 1e3)) for level in levels}
    return weights, {level: draw(st.integers(0, 1000)) for level in levels}


examples = settings(deadline=None)
batch_sizes = st.integers(0, 300)


def outcome(index: int, batch: int, level: int, *, failed: bool) -> Outcome:
    end, score = End.MERGED, -700.0 if failed else -3.0
    svo = 0.5 if level == 2 else None
    case = Case(level=level, x_pov0_m=-200.0, v_pov0_mps=30.0, svo_rad=svo, scenario=US23)
    return Outcome(index, batch, case, Measures(end=end, score=score, t_end_s=8.3))


class TestByHand:
    def test_the_odd_cases_go_to_the_levels_with_the_fewest_so_far(self):
        assert even_shares({0: 7, 1: 6, 2: 7}, 4) == {0: 1, 1: 2, 2: 1}
        assert even_shares({0: 7, 1: 6, 2: 5}, 5) == {0: 1, 1: 2, 2: 2}

    def test_a_batch_smaller_than_the_levels_serves_the_neediest(self):
        assert even_shares({0: 5, 1: 2, 2: 9}, 1) == {0: 0, 1: 1, 2: 0}
        assert even_shares({0: 5, 1: 2, 2: 9}, 2) == {0: 1, 1: 1, 2: 0}


class TestShares:
    @examples
    @given(weights_and_told(), batch_sizes)
    def test_add_up_to_the_batch(self, levels, n):
        weights, told = levels
        shares = whole_shares(weights, told, n)
        assert sum(shares.values()) == n
        assert list(shares) == sorted(weights)
        assert all(type(share) is int and share >= 0 for share in shares.values())

    @examples
    @given(weights_and_told(), batch_sizes)
    def test_starve_no_level(self, levels, n):
        weights, told = levels
        shares = whole_shares(weights, told, n)
        served = {level for level, share in shares.items() if share}
        assert len(served) == min(n, len(weights))
        starved = set(weights) - served
        assert all(told[one] <= told[other] for one in served for other in starved)


class TestTheLastFailureShare:
    def test_counts_only_the_last_batch_that_had_cases_of_the_level(self):
        outcomes = [
            outcome(0, 0, 0, failed=False),
            outcome(1, 0, 1, failed=True),
            outcome(2, 1, 1, failed=True),
            outcome(3, 1, 1, failed=False),
            outcome(4, 1, 1, failed=False),
            outcome(5, 1, 1, failed=False),
            outcome(6, 2, 0, failed=True),
        ]
        assert last_failure_share(outcomes, 1) == 0.25
        assert last_failure_share(outcomes, 0) == 1.0
