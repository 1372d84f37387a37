"""Acceleration lanes: of a road, of a scenario, and in a new scenario."""

from __future__ import annotations

import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from support.foreign_nets import FOREIGN, LANE_M, LANES, foreign_lane_road, lane_drop

from merge_sumo import api
from merge_sumo.errors import UserError
from merge_sumo.road.finder import find_road, read_net
from merge_sumo.road.loader import road_for
from merge_sumo.road.road import Road
from merge_sumo.road.scenario_file import named_scenario

EXACT = 1e-9


@pytest.fixture(scope="module")
def road(tmp_path_factory):
    """Return a function that finds the acceleration lane of a net, of which LANE_M is a part."""
    found = {"us23-lane": road_for(named_scenario("us23-lane"))}

    def get(name: str) -> Road:
        if name not in found:
            found[name] = foreign_lane_road(name, tmp_path_factory.mktemp("net"))
        return found[name]

    return get


def test_the_shipped_road_has_m_at_a_share_of_035_of_200_m(road):
    us23 = road("us23-lane")
    assert us23.used_lane_m == (-70.0, 130.0)
    for path, lanes, starts_m in (
        (us23.ramp, ["ramp_0", "lane_0", "main_out_0"], [-425.0, -70.0, 130.0]),
        (us23.mainline, ["main_in_0", "lane_1", "main_out_0"], [-1000.0, -70.0, 130.0]),
    ):
        assert [piece.lane for piece in path.pieces] == lanes
        assert path.starts_m == starts_m
    assert us23.lane_point(0.0, on_ramp=False) == ("lane_1", 70.0, 0.0, 0.0, 90.0)
    assert us23.lane_point(0.0, on_ramp=True) == ("lane_0", 70.0, 0.0, -3.2, 90.0)


class TestTheWindow:
    @pytest.mark.parametrize("name", LANES)
    def test_ends_where_the_scenario_says_and_begins_at_the_gore(self, road, name):
        own = road(name)
        begin_m, end_m = own.used_lane_m
        assert end_m == LANE_M[1]
        for path in (own.mainline, own.ramp):
            assert {begin_m, end_m} <= set(path.starts_m)
            for one, other in pairwise(path.pieces):
                assert one.start_m + one.length_m == pytest.approx(other.start_m, abs=EXACT)
        # Both are drawn a lane's width apart, and are at the same place along it.
        for x_m in np.linspace(begin_m + 1.0, end_m - 1.0, 9).tolist():
            main, ramp = (own.lane_point(x_m, on_ramp=on_ramp) for on_ramp in (False, True))
            assert np.hypot(main.x_m - ramp.x_m, main.y_m - ramp.y_m) == pytest.approx(3.2, abs=0.1)

    def test_that_is_longer_than_the_lane_is_refused(self, tmp_path):
        net = read_net(lane_drop(tmp_path))
        said = r"is -150 to 130, 280 m, .* 215\.4 m long: write lane_m = \[-75\.4, 139\.9\]$"
        with pytest.raises(UserError, match=said):
            find_road(net, ["in", "acc", "out"], ["ramp", "acc", "out"], lane_m=(-150.0, 130.0))

    def test_is_refused_on_a_road_without_such_a_lane(self, tmp_path):
        build, mainline, ramp = FOREIGN["priority"]
        net = read_net(build(tmp_path))
        with pytest.raises(UserError, match=r"meet at a point, .* remove lane_m"):
            find_road(net, mainline.split(), ramp.split(), lane_m=LANE_M)


class TestAScenario:
    @staticmethod
    def new(folder, build, mainline, ramp, **more):
        folder.mkdir(exist_ok=True)
        file = folder / "mine.toml"
        lines = api.new_scenario(
            file, net=build(folder), mainline=mainline, ramp=ramp, **more
        ).lines()
        return named_scenario(str(file)), lines

    def test_for_a_marked_lane_begins_before_the_gore_and_has_m_at_a_share_of_035(self, tmp_path):
        scenario, lines = self.new(tmp_path, *LANES["lane drop"])
        assert scenario.lane_m == (-75.4, 139.9)  # of 215.36 m
        assert (scenario.x_vut0_m, scenario.follow_up_s, scenario.lane_end) == (
            -182.0,
            5.0,
            "merge",
        )
        said = "acceleration lane: acc_0, from -75.5 m, the gore, to 139.9 m"
        assert said in lines
        assert said in api.check_scenario(scenario).record["about"]
        picture = (tmp_path / "mine.svg").read_text()
        for name in ("VUT", "POV", "M", "gore", "end of lane"):
            assert f">{name}</text>" in picture

    @pytest.mark.parametrize(
        ("length_m", "lane_m"),
        [(49.9, None), (2000.1, None), (50.0, (-17.5, 32.5))],
    )
    def test_for_an_unmarked_lane_has_a_choice_from_50_m_on(self, tmp_path, length_m, lane_m):
        def build(folder):
            return stretched(lane_drop(folder), length_m, 'acceleration="1"')

        scenario, lines = self.new(tmp_path, build, *LANES["lane drop"][1:])
        assert scenario.lane_m == lane_m
        assert any(line.startswith("lane next to") for line in lines) == (lane_m is None)

    def test_at_a_point_on_such_a_road_says_that_it_does_not_use_the_lane(self, tmp_path):
        scenario, lines = self.new(tmp_path, *LANES["lane drop"], point=True)
        assert (scenario.lane_m, scenario.follow_up_s) == (None, 3.0)
        assert "lane_end" not in (tmp_path / "mine.toml").read_text()
        # The gore is 215.36 + 8 m before M.
        said = "lane next to the mainline, not used as an acceleration lane: acc_0, from -223.4 m"
        assert any(line.startswith(said) for line in lines)


def stretched(net: Path, length_m: float, without: str = "\0") -> Path:
    """Give the lanes of edge acc another length, and take a text out of the file."""
    text = re.sub(r'(id="acc_\d" [^>]*length=)"[\d.]+"', rf'\1"{length_m}"', net.read_text())
    net.write_text(text.replace(without, ""))
    return net
