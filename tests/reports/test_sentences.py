"""The cause of each case against its recorded motion, for controllers of many families.

The second calculation is plain Python over the numbers of the trajectory, without the diagnosis and
the measures. An unknown sentence fails the test.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from pathlib import Path

import pytest
from lxml import etree
from support.campaigning import run_campaign

import merge_sumo as ms
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.metrics.cause import cause
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.reports.comparison_page import comparison_page
from merge_sumo.reports.junit import write_junit
from merge_sumo.reports.text import causes
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
LENGTH_M, NEAR_M, DT_S, BRAKED_MPS = 5.0, 6.0, 0.1, 1.0
NUMBER = r"(-?\d+(?:\.\d+)?)"
DOES = rf"(begins to brake at {NUMBER} s|accelerates|keeps its speed within 1 m/s)".replace(
    "(-", "(?:-"
)
CONDUCT = f"the VUT {DOES}, the POV {DOES}, and the VUT"
GOAL = "the (?:merge point|mainline)"
OTHERS = "in the place of the VUT .+ would have avoided it.*"
"""Of other drivers, which test_avoidance.py checks."""


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
    """The motion of the VUT and the nearest car, evaluated by plain arithmetic."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.pov, self.vut = (trajectory.motion[:, row].tolist() for row in (0, 1))
        self.after = trajectory.whole[len(self.vut) - 1 :, :2].tolist()
        x_pov, x_vut = self.pov[-1][0], self.vut[-1][0]
        self.dx, self.end_s = x_pov - x_vut, (len(self.vut) - 1) * DT_S
        self.lane_m = trajectory.case.scenario.lane_m
        self.place_m = x_vut if self.lane_m else 0.0
        self.arrived = trajectory.end is End.MERGED if self.lane_m else x_vut >= 0.0

    @staticmethod
    def braking_s(rows: Sequence[Sequence[float]]) -> float | None:
        """Return when a speed began to fall by 1 m/s: the last time that it was at its highest."""
        highest, since = rows[0][1], 0
        for step, (_, v, _) in enumerate(rows):
            if v >= highest - 1e-6:
                highest, since = max(v, highest), step
            elif highest - v >= BRAKED_MPS - 1e-6:
                return round(since * DT_S, 1)
        return None

    @staticmethod
    def gains(rows: Sequence[Sequence[float]]) -> bool:
        """Return whether a speed rose by 1 m/s."""
        lowest, most = rows[0][1], 0.0
        for _, v, _ in rows:
            lowest = min(lowest, v)
            most = max(most, v - lowest)
        return most >= BRAKED_MPS - 1e-6

    def conduct(self, rows: Sequence[Sequence[float]]) -> str:
        """Return what a car does, in words."""
        since = self.braking_s(rows)
        if since is not None:
            return f"begins to brake at {since:.1f} s"
        return "accelerates" if self.gains(rows) else "keeps its speed within 1 m/s"

    def way_out_s(self) -> float | None:
        """Return the last time from which full braking or acceleration keeps 6 m at the merge."""
        return max((s for s in range(len(self.vut) - 1) if self._keeps(s)), default=None)

    def _keeps(self, start: int) -> bool:
        for a in (2.0, -4.0):
            x, v = self.vut[start][:2]
            for step in range(start + 1, start + 301):
                x, v = x + v * DT_S, max(v + a * DT_S, 0.0)
                if x >= self.place_m:
                    over = max(step - len(self.pov) + 1, 0)
                    x_pov, v_pov, _ = self.pov[min(step, len(self.pov) - 1)]
                    if abs(x_pov + over * v_pov * DT_S - x) >= NEAR_M:
                        return True
                    break
                if v == 0.0:
                    return self.pov[-1][1] > 0.0
        return False


KINDS: dict[str, Callable[[float | None, float | None, float], bool]] = {
    "stalemate": lambda vut, pov, out: vut is not None and vut <= out and pov is not None,
    "squeeze": lambda vut, pov, _: vut is None and pov is None,
    "only the POV brakes": lambda vut, pov, _: vut is None and pov is not None,
    "late brake": lambda vut, pov, out: vut is not None and vut > out,
    "weak brake": lambda vut, pov, out: vut is not None and vut <= out and pov is None,
}
"""What is true of each kind, by when the VUT and the POV begin to brake and the last way out."""


def check_kind(kind: str, motion: Motion) -> None:
    step = motion.way_out_s()
    out = -1.0 if step is None else round(step * DT_S, 1)
    assert abs(motion.dx) < NEAR_M
    assert KINDS[kind](motion.braking_s(motion.vut), motion.braking_s(motion.pov), out)


def near(said: str, value: float, digits: int = 1) -> None:
    assert abs(float(said) - value) <= 0.5 * 10.0**-digits + 1e-4, (said, value)


def check_cause(text: str, outcome: Outcome, motion: Motion) -> None:
    """Check all that a cause says."""
    if outcome.measures.end is End.TIMEOUT:
        found = re.fullmatch(rf"Timeout: {CONDUCT} did not reach {GOAL} in (.+) s\.", text)
        assert found is not None, text
        vut, pov, after = found.groups()
        assert not motion.arrived
        near(after, motion.end_s, 0)
        assert (vut, pov) == (motion.conduct(motion.vut), motion.conduct(motion.pov))
        return
    found = re.fullmatch(
        rf"([A-Za-z ]+)(?:, (contact|conflict))?(?: at a relative speed of {NUMBER} m/s)?: "
        rf"{CONDUCT} (?:reaches M|merges at {NUMBER} of the lane) "
        rf"at {NUMBER} s, its front bumper {NUMBER} m (ahead of|behind) that of the POV\."
        r"(?: (.+)\.)?",
        text,
    )
    assert found is not None, text
    head, severity, _, vut, pov, share, at, apart, side, avoided = found.groups()
    head = head[0].lower() + head[1:]
    assert (vut, pov) == (motion.conduct(motion.vut), motion.conduct(motion.pov))
    assert motion.arrived
    near(at, motion.end_s)
    near(apart, abs(motion.dx))
    assert (side == "ahead of") == (motion.dx < 0.0)
    assert (share is None) == (motion.lane_m is None)
    if motion.lane_m is not None:
        begin_m, end_m = motion.lane_m
        near(share, (motion.place_m - begin_m) / (end_m - begin_m), 2)
    assert (abs(motion.dx) < NEAR_M) == (severity is not None) == (avoided is not None)
    if avoided is not None:
        check_kind(head, motion)
        check_avoided(avoided, motion)


def check_avoided(text: str, motion: Motion) -> None:
    step = motion.way_out_s()
    until = rf"The last way out, full braking or full acceleration of the VUT, closes at {NUMBER} s"
    never = "At no time does full braking or full acceleration of the VUT keep 6 m at (M|the merge)"
    found = re.fullmatch(f"(?:{never}|{until})(?:; {OTHERS})?", text)
    assert found is not None, text
    assert (step is None) == (found[2] is None)
    if step is not None:
        near(found[2], step * DT_S)


@pytest.fixture(scope="module")
def campaign_of(tmp_path_factory) -> Callable[[str], RecordedCampaign]:
    """Return the function that runs the campaign of a controller, once."""

    @cache
    def run(vut: str) -> RecordedCampaign:
        folder = tmp_path_factory.mktemp("sentences")
        settings = CampaignSettings(
            vut=spec_of(vut, folder),
            levels=(0, 1, 2),
            cases=CASES,
            batch=10,
            seed=11,
            scenario=ON_LANE if vut.startswith("stop:") else US23,
            fail_when="paper",
        )
        return run_campaign(settings, folder / "run")

    return run


@pytest.fixture(params=VUTS)
def campaign(request, campaign_of) -> RecordedCampaign:
    return campaign_of(request.param)


class TestTheCause:
    def test_of_each_case_is_true(self, campaign):
        for index, text in causes(campaign, campaign.cases).items():
            outcome = campaign.outcome(index)
            if outcome.measures.end.is_error:
                assert text.startswith(f"{outcome.measures.end} at ")
                continue
            check_cause(text, outcome, Motion(campaign.trajectory(index)))

    def test_is_said_first_wherever_the_case_is_shown(self, campaign_of, tmp_path):
        run = campaign_of("design1")
        outcome = next(o for o in run.cases if o.failed)
        index, said = outcome.index, causes(run, [outcome])[outcome.index]
        assert ms.run(recorded=(run.folder, index)).lines()[1] == said
        assert ms.replay(run.folder, index).lines()[1] == said
        assert ms.explain(run.folder, index).lines()[1].strip() == said
        write_junit(tmp_path / "junit.xml", ms.open_run(run.folder))
        assert said in [one.text for one in etree.parse(tmp_path / "junit.xml").iter("failure")]
        compared = ms.compare([run.folder, run.folder])
        without = cause(outcome, run.trajectory(index))
        assert said.startswith(without.removesuffix("."))
        assert comparison_page(compared).count(f": {without}</p>") == 2
