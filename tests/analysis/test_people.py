"""Failures beside published figures of people, by hand."""

# mypy: no-strict-optional

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import pytest
from handmade import write_run

import merge_sumo as ms
from merge_sumo.analysis.people import (
    BRAKING,
    HEE_PEOPLE,
    SLOWDOWN,
    Place,
    beside_people,
    none_of,
)
from merge_sumo.campaigns.store import Run, failures
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.studies.history import history_of
from merge_sumo.values.case import MergeCase
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import OWN, US23
from merge_sumo.values.score import Measures, Outcome
from merge_sumo.values.trajectory import End

ONE, TWO, FIVE = 1 / 23, 2 / 23, 5 / 23


def failing(index, brake_mps2, slowdown_mps=0.0, level=1, scenario=US23, **measured):
    """Return a failure in which the POV brakes, over 1.6 s, and slows down by so much."""
    case = MergeCase(level=level, x_pov0_m=-250.0 - index, v_pov0_mps=30.0, scenario=scenario)
    measures = Measures(
        end=End.MERGED,
        t_end_s=9.0,
        score=-700.0,
        pov_slowdown_mps=slowdown_mps,
        **{"pov_max_brake_mps2": brake_mps2, "pov_sustained_brake_mps2": brake_mps2} | measured,
    )
    return Outcome(index, 0, case, measures)


SAFE = replace(failing(9, 3.0, 9.0), index=9, measures=Measures(end=End.MERGED, t_end_s=9.0))


class TestThePlaceOfABehaviour:
    @pytest.mark.parametrize(
        ("published", "value", "at_least", "at_most"),
        [
            (BRAKING, 0.0, 1.0, 1.0),
            (BRAKING, 0.3, 0.5, 1.0),
            (BRAKING, 0.66, 0.5, 1.0),
            (BRAKING, 1.0, 0.05, 0.5),
            (BRAKING, 1.4, 0.05, 0.5),
            (BRAKING, 2.0, ONE, 0.05),
            (BRAKING, 2.06, ONE, 0.05),
            (BRAKING, 2.07, 0.0, 0.0),
            (SLOWDOWN, 0.5, FIVE, 1.0),
            (SLOWDOWN, 0.6, TWO, FIVE),
            (SLOWDOWN, 2.0, ONE, TWO),
            (SLOWDOWN, 9.0, 0.0, ONE),
        ],
    )
    def test_is_the_step_of_the_figures_that_it_lies_in(self, published, value, at_least, at_most):
        assert published.place(value) == Place(at_least, at_most)

    def test_never_rises_with_the_value_and_is_an_interval(self):
        for published in (BRAKING, SLOWDOWN):
            places = [published.place(value / 50.0) for value in range(-5, 200)]
            assert all(place.at_least <= place.at_most for place in places)
            for shares in zip(*((p.at_least, p.at_most) for p in places), strict=True):
                assert list(shares) == sorted(shares, reverse=True)

    def test_share_says_which_figure_is_the_limit(self):
        shares = (1.0, 0.96, 0.95, 0.9, 0.5)
        assert [BRAKING.limit(share) for share in shares] == [2.06, 2.06, 1.4, 1.4, 0.66]
        assert [SLOWDOWN.limit(share) for share in shares] == [None, None, 2.0, 1.0, 0.5]


class TestFailuresBesidePeople:
    OUTCOMES = (
        failing(0, 2.0, 4.0, merged_first="VUT", pet_s=0.4, ttc_s=1.0),
        failing(1, 3.0, 6.0, merged_first="VUT", pet_s=0.2),
        failing(2, 1.0, 1.5, merged_first="POV", pet_s=9.0, ttc_s=3.0),
        failing(3, 0.0, level=0),
        SAFE,
    )

    def test_are_inside_where_no_figure_shows_that_the_pov_did_more(self):
        found = beside_people(self.OUTCOMES)
        assert {i: p.inside for i, p in found.places.items()} == {0: 1, 1: 0, 2: 1, 3: 1}
        assert (found.failures, found.inside) == (4, 3)
        level = found.levels[1]
        assert (level.failures, level.inside, level.outside) == (3, 2, 1)
        assert (level.brakes_harder, level.slows_more, level.slows_beyond) == (1, 0, 2)
        assert (level.hardest_mps2, level.most_mps) == (3.0, 6.0)
        assert (level.pov_first, level.merged) == (1, 3)
        assert level.ttc_s == 2.0
        assert level.headway_s == pytest.approx(0.3), "of the POVs that come second alone"
        # Two cases 2 m apart in a pool of 160 m, from 340 m before M on: their balls overlap.
        points = [[(-250.0 - i + 340.0) / 160.0, 0.5] for i in (0, 2)]
        assert level.fmc == pytest.approx(fmc(points))

    def test_within_95_percent_of_people_brake_and_slow_down_less(self):
        found = beside_people(self.OUTCOMES, 0.95)
        assert [i for i, place in found.places.items() if place.inside] == [2, 3]
        assert (found.levels[1].brakes_harder, found.levels[1].slows_more) == (2, 2)
        assert "brakes at 1.4 m/s2 or less over 1.6 s and slows down by 2 m/s or less" in found.line

    def test_name_the_level_that_does_more_than_people(self):
        first, second = beside_people(self.OUTCOMES).findings
        assert first == (
            "level 1 brakes harder than any of 23 published drivers in 1 of 3 failures: a finding "
            "about this library of drivers"
        )
        assert second.startswith("level 1 slows down by more than 2 m/s in 2 of 3 failures")
        (own,) = beside_people([failing(0, 2.5, level=OWN)]).findings
        assert own.startswith("the POV of your own brakes harder than any of 23")
        traffic = named_scenario("us23-traffic")
        case = {"headway_ahead_s": 2.0, "headway_behind_s": 2.0}
        met = failing(0, 2.5, nearest="behind")
        met = replace(met, case=replace(met.case, scenario=traffic, **case))
        assert beside_people([met]).findings[0].startswith("the car met at level 1 brakes harder")

    def test_are_inside_with_a_peak_that_does_not_last(self):
        found = beside_people([failing(0, 1.9, 5.0, pov_max_brake_mps2=3.0), failing(1, 1.0)])
        assert found.inside == 2
        assert (found.levels[1].hardest_mps2, found.levels[1].peak_mps2) == (1.9, 3.0)
        assert found.findings[0] == (
            "level 1 brakes at 3 m/s2 for a moment, in 1 of 2 failures harder than any of 23 "
            "published drivers over 1.6 s, and not over 1.6 s itself, so that does not decide"
        )

    def test_of_old_records_are_inside_and_counted_where_a_measure_would_decide(self):
        old = [failing(i, a, None, pov_sustained_brake_mps2=None) for i, a in ((0, 1.0), (1, 3.0))]
        found = beside_people(old, 0.95)
        assert (found.inside, found.unknown, beside_people(old).unknown) == (2, 2, 1)
        assert found.places[1].braking is found.places[1].slowdown is None
        assert found.levels[1].hardest_mps2 is found.levels[1].most_mps is None
        assert found.findings == []

    def test_are_all_inside_where_the_figures_are_of_faster_roads(self):
        roundabout = named_scenario("roundabout")
        start: dict[str, Any] = {"x_pov0_m": -50.0, "v_pov0_mps": 8.0, "v_vut0_mps": 6.0}
        case = MergeCase(level=1, scenario=roundabout, **start)
        found = beside_people([replace(failing(0, 4.0), case=case)])
        assert (found.inside, found.places, found.findings) == (1, {}, [])
        assert found.line == (
            "beside people: no figures of people fit: the published drivers drive at 23.7 m/s in "
            "the mean, on a motorway, and the mainline starts at 12 m/s or less here"
        )

    def test_say_nothing_without_failures(self):
        assert beside_people([SAFE]).line is None
        assert beside_people([], levels=(0, 1)).levels.keys() == {0, 1}

    @pytest.mark.parametrize("share", [0.0, -1.0, 1.01, math.nan])
    def test_need_a_share_of_people(self, share):
        with pytest.raises(UserError, match="it is a share of people, above 0 and up to 1"):
            beside_people([], share)


def test_what_none_of_23_drivers_does_may_be_that_of_one_of_eight():
    share = none_of(HEE_PEOPLE)
    assert (1.0 - share) ** 23 == pytest.approx(0.05)
    assert f"{share:.1%}" == "12.2%"
    assert "up to 12.2% of drivers" in beside_people([]).caveat


class TestTheShareOfACampaign:
    def test_is_recorded_and_changed_by_resuming_and_by_a_report_of_another_share(self, tmp_path):
        few: dict[str, Any] = {"level": 1, "cases": 20, "sampler": "uniform", "workers": 1}
        run = ms.campaign("design2", out=tmp_path / "run", people=0.95, **few)
        outcomes = (run.folder / "outcomes.jsonl").read_bytes()
        assert run.settings["people"] == run.people.share == 0.95
        page = ms.report(run.folder, people=0.5)
        assert Run(run.folder).people == 0.95
        assert run.report() == page
        again = ms.resume(run.folder, people=0.9, workers=1)
        assert Run(run.folder).people == again.people.share == 0.9
        assert (run.folder / "outcomes.jsonl").read_bytes() == outcomes

    def test_is_refused_before_the_first_case(self, tmp_path):
        with pytest.raises(UserError, match="--people is 0:"):
            ms.campaign("design2", out=tmp_path / "run", people=0)
        with pytest.raises(UserError, match="--people is 3:"):
            ms.report(write_run(tmp_path / "other", 20).folder, people=3)

    def test_of_a_folder_that_names_none_is_that_of_the_hardest(self, tmp_path):
        run = write_run(tmp_path / "run", 20, levels=(1,))
        assert "people" not in run.settings
        assert run.people == 1.0
        found = ms.open_run(run.folder)
        assert found.people.inside == len(failures(run.outcomes)) > 0
        assert found.to_record()["people"]["levels"]["1"]["outside"] == 0
        assert any(line.startswith("beside people: ") for line in found.lines())
        strange = write_run(tmp_path / "strange", 20, people="most")
        with pytest.raises(UserError, match="something else than a share as people"):
            _ = strange.people

    def test_is_of_each_version_in_a_history(self, tmp_path):
        runs = [write_run(tmp_path / str(s), 20, levels=(1,), people=s) for s in (1.0, 0.5)]
        found = history_of(runs)
        number = len(failures(runs[0].outcomes))
        assert [version.people.inside for version in found.versions] == [number, 0]
        assert found.notes == ("The campaigns hold failures beside different shares of people.",)
        page = tmp_path / "history.html"
        ms.history([run.folder for run in runs], out=page)
        assert "failures inside what people do" in page.read_text()
