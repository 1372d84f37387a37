"""Where failures lie: by hand."""

from __future__ import annotations

import numpy as np

from merge_sumo.campaigns.recorded import regions_of
from merge_sumo.metrics.failure_regions import failure_regions
from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.scenario.trajectory import End, Trajectory


def outcome(index: int, x: float, v: float, failed: bool, level: int = 1) -> Outcome:
    """Return an outcome of a case at (x, v), with both cars at M or far apart."""
    svo = 0.5 if level == 2 else None
    case = Case(level=level, x_pov0_m=x, v_pov0_mps=v, svo_rad=svo, scenario=US23)
    gap = 0.0 if failed else 40.0
    motion = np.array(
        [[[gap - v * DT_S, v, 0.0], [-1.8, 18.0, 0.0]], [[gap, v, 0.0], [0.0, 18.0, 0.0]]]
    )
    return Outcome(index, 0, case, Measures.of(Trajectory(case, motion, End.MERGED)))


def over_the_pool(fails, level: int = 1) -> list[Outcome]:
    places = [(x, v) for x in np.linspace(-340, -180, 33) for v in np.linspace(25, 35, 21)]
    return [outcome(n, x, v, fails(x, v), level) for n, (x, v) in enumerate(places)]


class TestRegions:
    def test_are_told_by_the_quantities_that_lie_close_together(self):
        outcomes = over_the_pool(lambda x, v: 8.3 < -x / v < 8.8)
        (region,) = failure_regions(outcomes, 1, regions_of(outcomes))
        # The first start due is (-220 m, 26.5 m/s), the last (-255 m, 29 m/s).
        assert region.where == "POV would reach M after 8.30 to 8.79 s"
        assert region.failures == region.cases == region.failing == sum(o.failed for o in outcomes)

    def test_have_numbers_from_the_largest_and_are_not_those_of_another_level(self):
        def fails(x, v):
            return (x > -190 and v > 33) or (x < -330 and v < 26.6) or (x, v) == (-260, 30)

        outcomes = over_the_pool(fails, level=2)
        assert failure_regions(outcomes, 1, regions_of(outcomes)) == []
        first, second = failure_regions(outcomes, 2, regions_of(outcomes))
        assert (first.number, first.failures, second.number, second.failures) == (0, 8, 1, 8)
        bounds = "x_POV0 -185 to -180 m, v_POV0 33.5 to 35.0 m/s"
        assert second.where == f"POV would reach M after 5.14 to 5.52 s, {bounds}"

    def test_of_a_level_where_everything_fails_are_the_whole_pool(self):
        outcomes = over_the_pool(lambda x, v: True)
        (region,) = failure_regions(outcomes, 1, regions_of(outcomes))
        assert (region.where, region.failures, region.cases) == ("anywhere", 693, 693)
