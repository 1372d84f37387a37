"""The share of starts that fail: by hand, against many more starts, and where it is unknown."""

from __future__ import annotations

import numpy as np
import pytest
from campaigning import campaign_settings, run_campaign

from merge_sumo import api
from merge_sumo.campaigns.plan import resolve
from merge_sumo.engine.evaluate import THIS_PROCESS, CasesAt, evaluate
from merge_sumo.errors import UserError
from merge_sumo.studies.share import SHARES, LevelShare, fails_of


@pytest.mark.parametrize(
    ("failures", "says"),
    [
        # 1 - .05 ** (1 / 2000), one-sided
        (0, "less than 0.15 %"),
        # The quantiles of beta(38, 1963) and beta(39, 1962).
        (38, "1.9 % [1.3, 2.6]"),
        (2000, "100 % [99.8, 100]"),
    ],
)
def test_is_said_with_its_exact_interval(failures, says):
    assert LevelShare(level=0, cases=2000, failures=failures).shown == says


def test_of_a_campaign_holds_the_share_of_many_more_starts(tmp_path):
    run = api.campaign("design1", level=0, seed=4, cases=30, out=tmp_path / "run")
    shares = SHARES.read(run.folder)
    assert shares is not None
    [level] = shares.levels
    plan = resolve(campaign_settings(vut="design1")).with_engine(None)
    points = np.random.default_rng(99).random((20_000, 2))
    pool = campaign_settings(vut="design1").pool
    many = evaluate(plan, CasesAt(pool, 0, points), THIS_PROCESS, fails_of)
    share = sum(fails for _, fails in many) / len(points)
    low, high = level.interval
    assert low < share < high
    assert (level.cases, level.failures > 0) == (2000, True)
    assert any(f"  {level.shown} of all starts fail  " in line for line in run.lines())
    again = api.campaign("design1", level=0, seed=4, cases=30, out=tmp_path / "two", workers=2)
    assert SHARES.read(again.folder) == shares


def test_a_case_runs_after_a_campaign_of_worker_processes(tmp_path):
    run = api.campaign("design1", level=0, seed=4, cases=30, out=tmp_path / "run", workers=2)
    assert SHARES.read(run.folder) is not None
    first = run.run.outcomes[0]
    assert api.run(recorded=(run.folder, 0)).measures == first.measures


def test_of_a_controller_that_needs_sumo_is_not_measured_and_the_command_is_named(tmp_path):
    run = api.campaign("sumo:IDM", level="0", cases=10, out=tmp_path / "run", progress=False)
    assert SHARES.read(run.folder) is None
    said = f"starts that fail are not measured: merge-sumo probability {run.folder}"
    assert any(line.endswith(said) for line in run.lines())


def test_of_another_persons_file_is_data(tmp_path):
    run = run_campaign(campaign_settings(vut="design1", cases=10), tmp_path / "run")
    (run.folder / SHARES.name).write_text('{"levels": [{"level": 0, "cases": -3, "failures": 0}]}')
    with pytest.raises(UserError, match=r"shares\.json"):
        api.open_run(run.folder).lines()
