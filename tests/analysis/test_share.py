"""The share of starts that fail: by hand, against many more starts, and where it is unknown."""

# mypy: no-strict-optional

from __future__ import annotations

import pytest
from support.campaigning import campaign_settings

from merge_sumo import api
from merge_sumo.analysis import share
from merge_sumo.analysis.run_study import end_of
from merge_sumo.analysis.share import SHARES, LevelShare, uniform_cases
from merge_sumo.simulation.evaluate import simulate_part


@pytest.mark.parametrize(
    ("failures", "says"),
    [
        # 1 - .05 ** (1 / 2000), one-sided
        (0, "< 0.15 %"),
        # The quantiles of beta(38, 1963) and beta(39, 1962).
        (38, "1.9 %  (1.3 to 2.6)"),
        # The quantiles of beta(1, 2000) and beta(2, 1999), with one digit below 0.1 %.
        (1, "0.05 %  (0.001 to 0.28)"),
        (2000, "100 %  (99.8 to 100)"),
    ],
)
def test_is_said_with_its_exact_interval(failures, says):
    assert LevelShare(level=0, cases=2000, failures=failures).shown == says


def test_of_a_campaign_holds_the_share_of_many_more_starts(tmp_path, monkeypatch):
    monkeypatch.setattr(share, "CASES", 2000)
    run = api.campaign("design1", level=0, seed=4, cases=30, out=tmp_path / "run")
    shares = SHARES.read(run.folder)
    assert shares is not None
    [level] = shares.levels
    low, high = level.interval
    # .0229 of the pool fail: a truth of 1,000,000 uniform cases.
    assert low < 0.0229 < high
    assert (level.cases, level.failures > 0) == (2000, True)
    assert f"\n0           {level.shown}  " in str(run)


OWN = """
class Own:
    def act(self, seen):
        return 1.0

class Fragile:
    def act(self, seen):
        if seen.t_s == 0.0 and seen.v_pov_mps > 34.0:
            raise ValueError("no idea")
        return 1.0

class Broken:
    def act(self, seen):
        raise ValueError("no idea")
"""


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Work in a folder with controllers of the user."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "own.py").write_text(OWN)


@pytest.mark.usefixtures("own")
def test_of_a_controller_of_the_user_is_measured_too():
    run = api.campaign("own.py:Own", level="0,1", seed=4, cases=10, out="run", progress=False)
    shares = SHARES.read(run.folder)
    assert shares is not None
    plan = campaign_settings(vut="own.py:Own", levels=(0, 1)).load_plan()
    for level, one in enumerate(shares.levels):
        assert one.cases == 200
        cases = uniform_cases(plan.scenario, level, 200, seed=4)
        ends = simulate_part(plan.for_verdicts(), cases, end_of)
        assert one.failures == sum(failed for failed, _, _ in ends)
        assert one.failures or level == 1
        assert f"\n{level}           {one.shown}  " in str(run)


@pytest.mark.usefixtures("own")
def test_of_a_controller_that_errs_says_so_or_is_not_measured():
    run = api.campaign("own.py:Fragile", level=0, seed=4, cases=10, out="run", progress=False)
    [level] = SHARES.read(run.folder).levels
    assert 0 < level.without_verdict < level.cases
    (fact,) = (fact for fact in run.facts if fact.name == "uniform starts without a verdict")
    assert fact.value == level.without_verdict
    run = api.campaign("own.py:Broken", level=0, seed=4, cases=4, out="broken", progress=False)
    assert SHARES.read(run.folder) is None
    command = "merge-sumo probability broken --vut own.py:Broken"
    assert f"to measure it, run\n             {command}" in str(run)


def test_of_a_campaign_of_uniform_cases_is_that_of_its_own_cases(tmp_path):
    run = api.campaign(
        "sumo:IDM", sampler="uniform", level="0", cases=10, out=tmp_path / "run", progress=False
    )
    failures = sum(outcome.failed for outcome in run.recorded.outcomes)
    [level] = SHARES.read(run.folder).levels
    assert level == LevelShare(level=0, cases=10, failures=failures)
    assert f"\n0           {level.shown}  " in str(run)
    assert "is measured by" not in str(run)


class Parked:
    """A VUT that stands on the ramp."""

    def act(self, seen: object) -> float:
        return -4.5


def test_no_share_or_probability_is_stated_of_a_vut_that_never_merges(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    run = api.campaign(Parked, level=0, cases=4, out="run", progress=False)
    [level] = SHARES.read(run.folder).levels
    assert level.failures == 0
    assert level.without_verdict == level.cases
    assert "POV level   failures found" in str(run), "and no share"
    found = api.probability(run, vut=Parked, cases=20)
    assert found.lines() == [
        "P(fail) is unknown: no case was judged, the VUT never reached the merge point"
    ]
