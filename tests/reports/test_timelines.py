"""The timeline of each case against its recorded motion, for controllers of many families.

The second calculation is plain Python over the numbers of the trajectory, without the timeline and
the measures. An unknown event fails the test.
"""

# mypy: no-strict-optional

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from lxml import etree
from support.campaigning import run_campaign

import merge_sumo as ms
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.metrics.timeline import Timeline
from merge_sumo.reports.junit import write_junit
from merge_sumo.reports.text import timelines
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End, Trajectory

TRIALS = Path(__file__).parents[2] / "tools" / "trial_vuts.py"
OWN = {
    "Startled": "return -4.0 if abs(seen.x_pov_m - seen.x_vut_m) < 12.0 else 1.0",
    "Waits": "return 0.7 if seen.x_vut_m < -20.0 else -0.4, seen.x_pov_m > seen.x_vut_m + 5.0",
}
"""Controllers of the tests, by what `act` returns."""
VUTS = ("design1", "gap", "level2", "sumo:IDM", "trial:Delayed", "own:Startled", "stop:Waits")
CASES = 40
"""Of each controller."""
ON_LANE = replace(named_scenario("us23-lane"), name="stop", follow_up_s=0.0, lane_end="stop")
LENGTH_M, NEAR_M, DT_S, CHANGED_MPS = 5.0, 6.0, 0.1, 1.0
NUMBER = r"(-?\d+(?:\.\d+)?)"
CAR = "(VUT|POV|car ahead of the POV|car behind the POV)"
CARS = {"POV": 0, "VUT": 1, "car ahead of the POV": 2, "car behind the POV": 3}


def spec_of(vut: str, folder: Path) -> str:
    """Return the specification of a controller; those of the tests are written to a file."""
    kind, _, name = vut.partition(":")
    if kind == "trial":
        return f"{TRIALS}:{name}"
    if name not in OWN:
        return vut
    file = folder / f"{name.lower()}.py"
    file.write_text(f"class {name}:\n    def act(self, seen):\n        {OWN[name]}\n")
    return f"{file}:{name}"


class Motion:
    """The motion of an episode, evaluated by plain arithmetic."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.whole = trajectory.whole.tolist()
        self.scenario, self.ended = trajectory.case.scenario, trajectory.end
        self.end = len(trajectory.motion) - 1
        self.last = len(self.whole) - 1
        self.others = [car for car in range(len(self.whole[0])) if car != 1]
        self.nearest = self.nearest_at(self.end)
        self.dx = self.apart(self.end, self.nearest)
        x_vut = self.whole[self.end][1][0]
        self.place_m = x_vut if self.scenario.lane_m else 0.0
        self.arrived = trajectory.end is End.MERGED if self.scenario.lane_m else x_vut >= 0.0

    def apart(self, row: int, car: int) -> float:
        return self.whole[row][car][0] - self.whole[row][1][0]

    def nearest_at(self, row: int) -> int:
        return min(self.others, key=lambda car: abs(self.apart(row, car)))

    def v(self, row: int, car: int) -> float:
        return self.whole[row][car][1]

    def phase_end(self, car: int, row: int, sign: int) -> int:
        """Return where a phase that begins at a row is at its end, before a pause or a return."""
        last = row
        for now in range(row, self.last):
            if sign * (self.v(now + 1, car) - self.v(now, car)) >= 0.01 - 1e-6:
                if (
                    now - last >= 10
                    or sign * (self.v(last, car) - self.v(now, car)) >= CHANGED_MPS - 1e-6
                ):
                    break
                last = now + 1
        return max(range(row, last + 1), key=lambda one: sign * self.v(one, car))

    def trend(self, car: int, row: int) -> int:
        """Return 1 for a car that accelerates at last in the 3 s before a row, -1 for braking."""
        for before in range(row, max(row - 30, 0) - 1, -1):
            gained = self.v(row, car) - self.v(before, car)
            if abs(gained) >= CHANGED_MPS - 1e-6:
                return 1 if gained > 0.0 else -1
        return 0

    def way_out_s(self) -> float | None:
        """Return the last time from which full braking or acceleration keeps 6 m at the merge."""
        return max((0.1 * s for s in range(self.end) if self._keeps(s)), default=None)

    def _keeps(self, start: int) -> bool:
        for a in (2.0, -4.0):
            x, v = self.whole[start][1][:2]
            for step in range(start + 1, start + 301):
                x, v = x + v * DT_S, max(v + a * DT_S, 0.0)
                if x >= self.place_m - 1e-9:
                    if all(abs(self.x_then(car, step) - x) >= NEAR_M for car in self.others):
                        return True
                    break
                if v == 0.0:
                    return all(self.v(self.end, car) > 0.0 for car in self.others)
        return False

    def x_then(self, car: int, step: int) -> float:
        """Return where a car is at a step; after the merge it keeps its speed."""
        x, v, _ = self.whole[min(step, self.end)][car]
        return x + max(step - self.end, 0) * v * DT_S


def near(said: str | float, value: float, digits: int = 1) -> None:
    assert abs(float(said) - value) <= 0.5 * 10.0**-digits + 1e-4, (said, value)


def check_event(text: str, row: int, m: Motion) -> None:
    """Check all that an event says, by the motion alone."""
    if found := re.fullmatch(
        rf"the {CAR} (brakes|accelerates): {NUMBER} to {NUMBER} m/s(?:, {NUMBER} s too late)?", text
    ):
        name, does, begin, end, late = found.groups()
        car, sign = CARS[name], -1 if does == "brakes" else 1
        last = m.phase_end(car, row, sign)
        near(begin, m.v(row, car))
        near(end, m.v(last, car))
        assert sign * (m.v(last, car) - m.v(row, car)) >= CHANGED_MPS - 1e-5
        assert sign * (m.v(row + 1, car) - m.v(row, car)) > 0.0
        if late is not None:
            near(late, row * DT_S - m.way_out_s())
            assert (name, does) == ("VUT", "brakes")
    elif found := re.fullmatch(
        rf"the VUT (?:reaches the merge point|merges at {NUMBER} of the lane,) "
        rf"{NUMBER} m (ahead of|behind) the {CAR}(?:: (.+))?",
        text,
    ):
        share, apart, side, name, more = found.groups()
        assert (m.arrived, row, CARS[name]) == (True, m.end, m.nearest)
        near(apart, abs(m.dx))
        assert (side == "ahead of") == (m.dx < 0.0)
        assert (share is None) == (m.scenario.lane_m is None)
        if share is not None:
            begin_m, end_m = m.scenario.lane_m
            near(share, (m.place_m - begin_m) / (end_m - begin_m), 2)
        if more == "closer than 6 m":
            assert abs(m.dx) < NEAR_M
        elif more is not None and more.startswith("contact"):
            check_event(more, row, m)
        elif more is not None:
            name, needed = re.fullmatch(rf"the {CAR} must brake at {NUMBER} m/s2", more).groups()
            near(needed, -needed_mps2(m))
            assert m.v(m.end, CARS[name]) > min(m.v(m.end, car) for car in range(len(m.whole[0])))
    else:
        check_moment(text, row, m)


def check_moment(text: str, row: int, m: Motion) -> None:
    """Check all that an event says that is no phase and no merge."""
    if found := re.fullmatch(rf"contact(?: with the {CAR})? at {NUMBER} m/s", text):
        # In the plane, lanes that meet at an angle add to the length and to the difference.
        rows = range(m.end, len(m.whole))
        touch = [r for r in rows if abs(m.apart(r, m.nearest_at(r))) <= LENGTH_M]
        assert row <= min(touch, default=m.end)
        assert found[1] is None or CARS[found[1]] == m.nearest_at(row)
        assert abs(m.apart(row, m.nearest_at(row))) < LENGTH_M + 0.5
        assert float(found[2]) >= abs(m.v(row, m.nearest_at(row)) - m.v(row, 1)) - 0.06
    elif found := re.fullmatch(
        rf"the {CAR} brakes hardest: {NUMBER} m/s2, down to {NUMBER} m/s", text
    ):
        near(found[2], m.whole[row][CARS[found[1]]][2])
        near(found[3], min(m.v(now, CARS[found[1]]) for now in range(row, len(m.whole))))
        assert row >= m.end
    elif text == "last way out: full braking or full acceleration":
        near(row * DT_S, m.way_out_s())
    elif text.startswith("no way out: "):
        assert m.way_out_s() is None
    elif text.startswith("the VUT did not reach "):
        assert not m.arrived
    else:
        assert re.match("reference drivers that |last time at which |fails: margin ", text), text


def needed_mps2(m: Motion) -> float:
    """Return the braking that keeps bodies apart after the merge, begun after 0.75 s."""
    needed = [0.0]
    for car in m.others:
        dx, closing = m.apart(m.end, car), m.v(m.end, 1) - m.v(m.end, car)
        closing = max(closing if dx >= 0.0 else -closing, 0.0)
        needed.append(closing**2 / (2.0 * (abs(dx) - LENGTH_M - 0.75 * closing)))
    return max(needed)


KINDS: dict[str, Callable[[int, int, bool], bool]] = {
    "late brake": lambda vut, _, late: vut < 0 and late,
    "both brake": lambda vut, car, late: vut < 0 and car < 0 and not late,
    "weak brake": lambda vut, car, late: vut < 0 and car >= 0 and not late,
    "both accelerate": lambda vut, car, _: vut > 0 and car > 0,
    "squeeze": lambda vut, car, _: vut == 0 or (vut > 0 and car <= 0),
}
"""What is true of each kind, by the trends of VUT and car, and whether the VUT braked too late."""


def check(told: Timeline, outcome: Outcome, m: Motion) -> None:
    """Check all that a timeline says."""
    times = [event.time_s for event in told.events]
    assert times == sorted(times)
    if outcome.failed:
        m.last = round(times[-1] / DT_S)
    for event in told.events:
        check_event(event.text, round(event.time_s / DT_S), m)
    if told.kind is None or told.kind in ("rule broken", "did not arrive"):
        return
    row = round(times[-1] / DT_S)
    car = m.nearest_at(row)
    is_late = m.way_out_s() is None
    for event in told.events:
        if event.text.startswith("the VUT brakes: "):
            is_late = m.way_out_s() is None or "too late" in event.text
    if told.kind == "cut in":
        assert abs(m.dx) >= NEAR_M
        assert row >= m.end
    else:
        is_late = is_late and abs(m.dx) < NEAR_M
        assert KINDS[told.kind](m.trend(1, row), m.trend(car, row), is_late)


def check_complete(told: Timeline, m: Motion) -> None:
    """Check that each second in which a speed changes by 1 m/s is in a phase that is told."""
    for car in (m.nearest, 1):
        name = next(name for name, index in CARS.items() if index == car)
        phases = []
        for event in told.events:
            if found := re.match(f"the {name} (brakes|accelerates): ", event.text):
                sign, row = (-1 if found[1] == "brakes" else 1), round(event.time_s / DT_S)
                phases.append((sign, row, m.phase_end(car, row, sign)))
        for row in range(m.last - 10):
            gained = m.v(row + 10, car) - m.v(row, car)
            if abs(gained) >= CHANGED_MPS:
                sign = 1 if gained > 0.0 else -1
                assert any(s == sign and a < row + 10 and row < b for s, a, b in phases)


@pytest.fixture(scope="module", params=VUTS)
def campaign(request, tmp_path_factory) -> RecordedCampaign:
    """Return the campaign of a controller."""
    folder = tmp_path_factory.mktemp("timelines")
    settings = CampaignSettings(
        vut=spec_of(request.param, folder),
        levels=(0, 1, 2),
        cases=CASES,
        batch=10,
        seed=11,
        scenario=ON_LANE if request.param.startswith("stop:") else US23,
        fail_when="paper",
    )
    return run_campaign(settings, folder / "run")


class TestTheTimeline:
    def test_of_each_case_is_true(self, campaign):
        for index, told in timelines(campaign, campaign.cases).items():
            outcome = campaign.outcome(index)
            if not outcome.measures.end.is_error:
                motion = Motion(campaign.trajectory(index))
                check(told, outcome, motion)
                check_complete(told, motion)

    @pytest.mark.parametrize("campaign", ["design1"], indirect=True)
    def test_is_told_wherever_the_case_is_shown(self, campaign, tmp_path):
        outcome = next(o for o in campaign.cases if o.failed)
        index, told = outcome.index, timelines(campaign, [outcome])[outcome.index]
        _, *lines = told.lines(outcome.case)
        without = [line for line in lines if "reference" not in line and "avoids" not in line]
        assert ms.explain(campaign.folder, index).lines()[1 : len(lines) + 1] == lines
        ran = ms.run(recorded=(campaign.folder, index))
        assert ran.lines()[1 : len(without) + 1] == without
        assert ran.timeline.events[-1] == told.events[-1]
        assert ms.replay(campaign.folder, index).lines()[1:-1] == without
        write_junit(tmp_path / "junit.xml", ms.open_run(campaign.folder))
        failures = etree.parse(tmp_path / "junit.xml").iter("failure")
        assert told.in_a_line in [one.text for one in failures]
