"""A scenario is a value: an error in one is a sentence, and its numbers hold in every case."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from support.calling import invoke
from support.foreign_nets import FOREIGN
from support.merges import SMALLER

from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.scenario_suggestion import suggested, unseen
from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import Measures
from merge_sumo.road.loader import road_for
from merge_sumo.road.scenario_file import named_scenario, to_toml
from merge_sumo.scenario.case import Case, Pool, to_unit
from merge_sumo.scenario.scenario import RANGES, US23, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory


def test_the_shipped_scenario_has_the_numbers_of_the_paper():
    assert (US23.x_pov0_m, US23.v_pov0_mps) == ((-340.0, -180.0), (25.0, 35.0))
    assert (US23.x_vut0_m, US23.v_vut0_mps, US23.max_steps) == (-182.0, 18.0, 300)
    assert (US23.a_min_mps2, US23.a_max_mps2) == (-4.0, 2.0)
    assert (US23.v_hw_max_mps, US23.v_hw_min_mps, US23.v_min_mps) == (35.0, 24.6, 12.0)
    assert (US23.ttc_min_s, US23.dx_crash_m, US23.dx_critical_m) == (7.0, 6.0, 15.0)
    assert (US23.level0_a_mps2, US23.level0_v_mps) == (1.0, 28.0)


class TestAFile:
    def test_gives_back_what_was_written(self, tmp_path):
        written = replace(US23, name="mine", x_pov0_m=(-220.0, -90.5), v_vut0_mps=12.25)
        (tmp_path / "any.toml").write_text(to_toml(written, ["two", "lines"]))
        assert named_scenario(str(tmp_path / "any.toml")) == written

    def test_says_only_what_differs_and_finds_its_net_next_to_it(self, tmp_path):
        (tmp_path / "short.toml").write_text('net = "a/b.net.xml"\nx_vut0_m = -90\n')
        found = named_scenario(str(tmp_path / "short.toml"))
        net = str(tmp_path / "a" / "b.net.xml")
        assert found == replace(US23, name="short", net=net, x_vut0_m=-90.0)

    @pytest.mark.parametrize(
        ("line", "said"),
        [
            ("x_pov0_m = [-180, -340]", "x_pov0_m is -180..-340: write the lower number"),
            ("x_pov0_m = -180", "x_pov0_m is -180: it must be two numbers, [low, high]"),
            ("x_pov_m = [-340, -180]", "has no 'x_pov_m': it has "),
            ("reach_m = 300", "x_pov0_m is (-340.0, -180.0): choose starts up to reach_m, 300 m"),
            ("v_vut0_mps = nan", "v_vut0_mps is nan: choose 0 to 100"),
            ("a_min_mps2 = 3", "a_min_mps2 is 3: choose -20 to -0.01"),
            ("dx_crash_m = 20", "dx_crash_m is 20.0: choose up to dx_critical_m"),
            ("headway_behind_s = [1.0, 4.0]", "(1.0, 4.0): choose both headways or neither"),
            ('mainline = "e1 e2"', "mainline is 'e1 e2': it must be edges"),
        ],
    )
    def test_with_a_wrong_value_is_refused_by_its_name(self, tmp_path, line, said):
        path = tmp_path / "wrong.toml"
        path.write_text(f"# a comment\nlevel0_v_mps = 25.0\n{line}\n")
        with pytest.raises(UserError) as refused:
            named_scenario(str(path))
        assert said in str(refused.value)
        assert str(refused.value).startswith(f"{path}: ")

    @pytest.mark.parametrize("field", [f for f in fields(Scenario) if f.name in RANGES])
    @pytest.mark.parametrize("number", ["-1e200", "1" + "0" * 400])
    def test_beyond_a_road_and_its_cars_is_refused_with_a_range(self, tmp_path, field, number):
        value = f"[{number}, {number}]" if field.type.startswith("Bounds") else number
        (tmp_path / "far.toml").write_text(f"{field.name} = {value}\n")
        with pytest.raises(UserError, match=rf"{field.name} is .*: (choose|it must be finite)"):
            named_scenario(str(tmp_path / "far.toml"))

    @pytest.mark.parametrize(
        ("content", "said"),
        [(b"x = [", "is not TOML"), (b"\xff", "not UTF-8 text"), (None, "No such file")],
    )
    def test_that_is_none_is_refused(self, tmp_path, content, said):
        if content is not None:
            (tmp_path / "no.toml").write_bytes(content)
        with pytest.raises(UserError, match=said):
            named_scenario(str(tmp_path / "no.toml"))


OTHER = replace(US23, name="other", x_pov0_m=(-300.0, -100.0), v_vut0_mps=10.0, dx_crash_m=4.0)


class TestACase:
    def test_is_a_point_of_the_pool_of_its_scenario(self):
        points = np.random.default_rng(0).random((5, 3))
        cases = Pool(levels=(2,), scenario=OTHER).cases(points, 2)
        assert {(case.scenario, case.v_vut0_mps) for case in cases} == {(OTHER, 10.0)}
        assert cases[0].x_pov0_m == -300.0 + 200.0 * points[0, 0]
        assert to_unit(cases, 2, scenario=US23) == pytest.approx(points)

    @pytest.mark.parametrize(("scenario", "is_close"), [(US23, True), (OTHER, False)])
    def test_is_judged_by_its_scenario(self, scenario, is_close):
        motion = np.array([[[x, 20.0, 0.0] for x in row] for row in ((-10.0, -2.0), (-5.0, 0.0))])
        case = Case(level=0, x_pov0_m=-250.0, v_pov0_mps=20.0, scenario=scenario)
        assert Measures.of(Trajectory(case, motion, End.MERGED)).is_close is is_close


@pytest.mark.parametrize("name", ["curved", "lane drop", "OpenDRIVE"])
def test_a_campaign_on_a_net_of_ones_own_is_two_commands(tmp_path, name):
    build, mainline, ramp = FOREIGN[name]
    net, file = build(tmp_path), tmp_path / "mine.toml"
    edges = ("--mainline", mainline, "--ramp", ramp)
    made = invoke("scenario", "new", file, "--net", net, *edges)
    assert made.exit_code == 0, made.output
    assert made.stdout.splitlines()[0] == f"net: {net.name}"
    assert b"<svg" in (tmp_path / "mine.svg").read_bytes()
    again = invoke("scenario", "new", file, "--net", net, *edges)
    assert isinstance(again.exception, UserError)
    assert "exists" in str(again.exception)
    assert invoke("scenario", "check", file).exit_code == 0
    options = ("--vut", "level0", "--level", "0", "--cases", "24", "--sampler", "uniform")
    ended = invoke("campaign", *options, "--scenario", file, "--out", tmp_path / "run", "--quiet")
    assert ended.exit_code == 0, ended.output
    run = RecordedCampaign(tmp_path / "run")
    assert all(o.measures.end is End.MERGED for o in run.outcomes)
    assert {o.failed for o in run.outcomes} == {True, False}, "it has a conflict"
    x, v, a = run.trajectory(0).motion[:, 1].T
    assert x[1:] == pytest.approx(x[:-1] + v[:-1] * 0.1, abs=1e-9)
    assert v[1:] == pytest.approx(v[:-1] + a[:-1] * 0.1, abs=1e-9)
    exported = invoke("export", run.folder, 0, "--out", tmp_path / "exported")
    assert exported.exit_code == 0, exported.output
    replayed = invoke("replay", tmp_path / "exported" / "case-00000")
    assert replayed.stdout.splitlines()[-1].startswith("identical"), replayed.output


def test_the_pool_that_us23_itself_suggests_is_about_that_of_the_paper():
    found = suggested(road_for(US23), "again")
    assert found.x_pov0_m == pytest.approx(US23.x_pov0_m, rel=0.1)
    assert (found.x_vut0_m, found.v_vut0_mps) == (US23.x_vut0_m, US23.v_vut0_mps)
    assert found.v_pov0_mps == pytest.approx(US23.v_pov0_mps, abs=0.6)


def test_where_the_learned_drivers_extrapolate_is_said_in_numbers_of_their_training():
    assert unseen(US23) == []
    assert unseen(SMALLER) == [], "a ramp a tenth shorter and slower is like ours"
    said = unseen(replace(US23, x_vut0_m=-364.0, x_pov0_m=(-680.0, -400.0), a_max_mps2=2.4))
    assert said == [
        "a_min_mps2 -4 corresponds to -8 in us23; training used -4",
        "a_max_mps2 2.4 corresponds to 4.8 in us23; training used 2",
        "level0_a_mps2 1 corresponds to 2 in us23; training used 1",
        "ttc_min_s 7 corresponds to 3.5 in us23; training used 7",
        "dx_crash_m 6 corresponds to 3 in us23; training used 6",
    ]
