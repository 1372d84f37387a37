"""Every sentence about a case against its recorded motion, for controllers of many families.

The second calculation is plain Python over the numbers of the trajectory: it shares nothing with
the diagnosis, the measures or the page. A sentence that it does not know fails the test.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from campaigning import run_campaign
from test_browser import browser, shown  # noqa: F401 (a fixture)

from merge_sumo.campaigns.run import Run
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.reports.motion import verdict_of
from merge_sumo.reports.report import REPORT, write_report
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.scenario.scenario import US23, as_merge, lane_of
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.verdict.score import Outcome

TRIALS = Path(__file__).parents[2] / "tools" / "trial_vuts.py"
OWN = {
    "Startled": "return -4.0 if abs(seen.x_pov_m - seen.x_vut_m) < 12.0 else 1.0",
    "Waits": "return 0.7 if seen.x_vut_m < -20.0 else -0.4, seen.x_pov_m > seen.x_vut_m + 5.0",
}
"""Controllers of the tests, by what `act` returns."""
VUTS = ("design2", "trial:Delayed", "own:Startled", "stop:Waits")
CONTESTED = replace(US23, name="contested", x_pov0_m=(-290.0, -230.0), v_pov0_mps=(27.0, 33.0))
"""US-23 with starts that make for encounters."""
ON_LANE = replace(
    as_merge(named_scenario("us23-lane")),
    name="contested-stop",
    x_pov0_m=CONTESTED.x_pov0_m,
    v_pov0_mps=CONTESTED.v_pov0_mps,
    follow_up_s=0.0,
    lane_end="stop",
)
"""The same with an acceleration lane, judged by the motion that is recorded."""
LENGTH_M, NEAR_M, DT_S, REACTION_S, BRAKED_MPS = 5.0, 6.0, 0.1, 0.75, 1.0
NUMBER = r"(-?\d+(?:\.\d+)?)"
PLACE = "(?:M|the merge)"


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


class Told:
    """What the motion of the VUT and the car that it met says, by plain arithmetic."""

    def __init__(self, trajectory: Trajectory) -> None:
        self.pov, self.vut = (trajectory.motion[:, row].tolist() for row in (0, 1))
        self.after = trajectory.whole[len(self.vut) - 1 :, :2].tolist()
        (x_pov, v_pov, _), (x_vut, v_vut, _) = self.pov[-1], self.vut[-1]
        self.dx, self.end_s = x_pov - x_vut, (len(self.vut) - 1) * DT_S
        self.gap = abs(self.dx) - LENGTH_M
        self.closing = v_vut - v_pov if self.dx >= 0.0 else v_pov - v_vut
        self.lane_m = lane_of(trajectory.case.scenario)
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
                return since * DT_S
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
        """Return what a car does, in the words of the page."""
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
    "stalemate": lambda vut, pov, _: vut is not None and pov is not None,
    "squeeze": lambda vut, pov, _: vut is None and pov is None,
    "only the POV brakes": lambda vut, pov, _: vut is None and pov is not None,
    "late brake": lambda vut, pov, out: (
        vut is not None and pov is None and not (vut <= (out or -1))
    ),
    "weak brake": lambda vut, pov, out: vut is not None and pov is None and vut <= (out or -1),
}
"""What is true of each kind, by when the VUT and the POV begin to brake and the last way out."""


def check_kind(kind: str, told: Told) -> None:
    step = told.way_out_s()
    out = -1.0 if step is None else round(step * DT_S, 1)
    assert abs(told.dx) < NEAR_M
    assert KINDS[kind](told.braking_s(told.vut), told.braking_s(told.pov), out)


def check_case(text: str, outcome: Outcome, told: Told) -> None:
    """Check every sentence of the case view."""
    sentences = re.split(r"(?<=\.) (?=[A-Z])", text)
    assert " ".join(sentences) == text
    for sentence in sentences:
        for pattern, check in CHECKS.items():
            if found := re.fullmatch(pattern, sentence):
                check(told, *found.groups())
                break
        else:
            pytest.fail(f"case {outcome.index}: no check of {sentence!r} in {text!r}")


def near(said: str, value: float, digits: int = 1) -> None:
    assert abs(float(said) - value) <= 0.5 * 10.0**-digits + 1e-4, (said, value)


def check_severity(told: Told, word: str, kind: str | None) -> None:
    if kind is not None:
        check_kind(kind, told)
    else:
        assert abs(told.dx) >= NEAR_M
    least_m = min(abs(pov[0] - vut[0]) for pov, vut in told.after) - LENGTH_M
    assert (word == "Contact") == (least_m <= 0.0)
    if word != "Contact":
        assert (word == "Conflict") == (abs(told.dx) < NEAR_M)
    if word in ("Harsh", "Safe"):
        behind = [rows[told.dx > 0.0] for rows in told.after]
        assert (word == "Harsh") == (max(-a for _, _, a in behind) > 3.0)


def check_arrival(told: Told, at: str, where: str | None, first: str, ahead: str) -> None:
    assert told.arrived
    near(at, told.end_s)
    near(ahead, abs(told.dx))
    assert first == ("VUT" if told.dx < 0.0 else "POV")
    assert (where is None) == (told.lane_m is None)
    if told.lane_m is not None and where is not None:
        begin_m, end_m = told.lane_m
        share = (told.place_m - begin_m) / (end_m - begin_m)
        assert share >= 0.0
        assert (where == "where the lane ends") == (share >= 1.0)
        if found := re.search(NUMBER, where):
            near(found.group(), 100.0 * share, 0)


def check_margin(told: Told, fails: str, margin: str) -> None:
    assert (fails == "Fails") == (abs(told.dx) < NEAR_M) == (float(margin) < 0.0)


def check_stood(told: Told, seconds: str) -> None:
    assert told.lane_m is not None
    near(seconds, DT_S * sum(x >= told.lane_m[0] and v < 0.1 for x, v, _ in told.vut))


def check_braking_after(told: Told, mps2: str | None) -> None:
    room = told.gap - told.closing * REACTION_S
    needed = max(told.closing, 0.0) ** 2 / (2.0 * room)
    if mps2 is None:
        assert 0.0 <= needed < 0.1
    else:
        near(mps2, needed)


def check_conduct(told: Told, vut: str, pov: str) -> None:
    assert (vut, pov) == (told.conduct(told.vut), told.conduct(told.pov))


def check_way_out(told: Told, until: str | None = None) -> None:
    step = told.way_out_s()
    assert (step is None) == (until is None)
    if until is not None and step is not None:
        near(until, step * DT_S)


def check_timeout(told: Told, after: str) -> None:
    assert not told.arrived
    near(after, told.end_s, 0)


def check_impact(told: Told, later: str | None, mps: str) -> None:
    assert later is None or told.gap > 0.0
    first = next((pov, vut) for pov, vut in told.after if abs(pov[0] - vut[0]) <= LENGTH_M)
    near(mps, abs(first[0][1] - first[1][1]))


def of_another_test(*_: object) -> None:
    """Accept what test_severity.py (before M) and test_avoidance.py (other drivers) check."""


CHECKS: dict[str, Callable[..., None]] = {
    r"(Contact|Conflict|Harsh|Safe)(?: \(([^)]+)\))?\.": check_severity,
    rf"The car behind has to brake at (?:less than 0\.1|{NUMBER}) m/s² after {PLACE}\.":
        check_braking_after,
    r"(Fails|Does not fail): margin (-?[\d.]+)\.": check_margin,
    r"The VUT (.+), the POV (.+)\.": check_conduct,
    rf"Full braking or full acceleration of the VUT would have kept 6 m at (?:M|this place) until "
    rf"{NUMBER} s\.": check_way_out,
    r"Neither full braking nor full acceleration of the VUT would ever have kept 6 m at this "
    r"place\.": check_way_out,
    rf"The VUT (?:reaches M|merges) at {NUMBER} s"
    r"(?:, (after \d+ % of the lane|where the lane ends))?; the front bumper of the (VUT|POV) is "
    rf"{NUMBER} m ahead\.": check_arrival,
    rf"The VUT stood on the lane for {NUMBER} s\.": check_stood,
    r"There never was a way out for the VUT\.": check_way_out,
    rf"Timeout: the VUT did not reach the (?:merge point|mainline) in {NUMBER} s\.": check_timeout,
    rf"Bodies touch( after (?:M|the merge),)? at a relative speed of {NUMBER} m/s\.": check_impact,
    r"In the VUT's place .+ would have avoided it\.": of_another_test,
    r"No reference driver in the VUT's place would have avoided it\.": of_another_test,
    r"The last time at which the fuzzy safety model \(fsm\) can take over .+ s\.": of_another_test,
    r"A careful driver in the POV's place avoids it, too\.": of_another_test,
}  # fmt: skip
"""The sentences of the case view, and what checks their numbers and words."""


@pytest.fixture(scope="module", params=VUTS)
def campaign(request, tmp_path_factory) -> Run:
    folder = tmp_path_factory.mktemp("sentences")
    settings = CampaignSettings(
        vut=spec_of(request.param, folder),
        levels=(0, 1, 2),
        sampler="uniform",
        cases=90,
        batch=90,
        seed=11,
        scenario=ON_LANE if request.param.startswith("stop:") else CONTESTED,
        fail_when="paper",
    )
    run = run_campaign(settings, folder / "run")
    write_report(run)
    return run


class TestWhatIsSaid:
    def test_of_each_case_by_the_page_is_true(self, campaign, browser):  # noqa: F811
        with shown(browser, campaign.folder / REPORT) as page:
            said = page.evaluate("cases.index.map((index, i) => [index, words(i)])")
        assert len(said) == len(campaign.outcomes)
        for index, text in said:
            outcome = campaign.outcome(index)
            if outcome.measures.end.is_error:
                assert text.startswith(outcome.measures.end)
                continue
            check_case(text, outcome, Told(campaign.trajectory(index)))

    def test_of_each_case_by_the_terminal_is_true(self, campaign):
        for outcome in campaign.outcomes:
            if not outcome.measures.end.is_tested:
                continue
            told = Told(trajectory := campaign.trajectory(outcome.index))
            found = re.fullmatch(
                rf"MERGED at {NUMBER} s, (contact|conflict|harsh|safe)"
                rf"(?: at a relative speed of {NUMBER} m/s)?: (?:the VUT merges (.+), )?"
                rf"the front bumper of the (VUT|POV) is {NUMBER} m ahead at {PLACE}"
                r"(?: \(([^:]+): .+\))?",
                verdict_of(outcome, trajectory),
            )
            assert found is not None
            at, word, impact, where, first, ahead, kind = found.groups()
            check_arrival(told, at, where, first, ahead)
            check_severity(told, word.capitalize(), kind)
            assert (impact is None) == (word != "contact")

    def test_in_words_is_true_of_the_cases_that_it_counts(self, campaign):
        model = ReportModel(campaign)
        for box in model.boxes:
            inside = [
                o
                for o in campaign.outcomes
                if o.case.level == box.level
                and all(low <= axis.value(o.case) <= high for axis, low, high in box.bounds)
            ]
            failing = [o for o in inside if abs(o.measures.dx_m or NEAR_M) < NEAR_M]
            assert (len(failing), len(inside)) == (box.failures, box.cases)
        for index, kind in model.kinds.items():
            check_kind(kind.value, Told(campaign.trajectory(index)))
