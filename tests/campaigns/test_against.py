"""A campaign against an earlier version finds what the new one fails that passed before."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree
from support.campaigning import campaign_settings, resume_campaign, run_campaign

from merge_sumo.analysis.comparison import Change, compare_against
from merge_sumo.campaigns.recorded import AGAINST, OUTCOMES, RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import UserError
from merge_sumo.metrics.fmc import RADIUS
from merge_sumo.samplers.candidates import spread_out
from merge_sumo.scenario.case import Case, Pool, to_unit
from merge_sumo.scenario.scenario import DT_S, US23, V_VUT0_MPS

OLD = "def f(seen):\n    return 0.0\n"
NEW = "def f(seen):\n    return 0.5 if seen.t_s < 3.0 else 0.0\n"
"""The old version keeps its speed, and the new one arrives some 0.8 s earlier."""


def gap_m(case: Case, accelerates_s: float) -> float:
    """Return the gap at M to a POV that keeps its speed, by eq. (4)."""
    x_m, v_mps, step = US23.x_vut0_m, V_VUT0_MPS, 0
    while x_m < 0.0:
        x_m += v_mps * DT_S
        v_mps += 0.5 * DT_S if step * DT_S < accelerates_s - 1e-9 else 0.0
        step += 1
    return case.x_pov0_m + case.v_pov0_mps * step * DT_S - x_m


def broke(case: Case) -> bool:
    """Return whether the new version alone fails, by the formula."""
    return abs(gap_m(case, 3.0)) < 6.0 <= abs(gap_m(case, 0.0))


@pytest.fixture(autouse=True)
def both(tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "cache"))
    Path("old.py").write_text(OLD)
    Path("new.py").write_text(NEW)


def settings(**changes) -> CampaignSettings:
    values = {"vut": "new.py:f", "against": "old.py:f", "cases": 20, "seed": 3}
    return campaign_settings(**{**values, **changes})


def lines(folder: Path) -> bytes:
    return (folder / OUTCOMES).read_bytes() + (folder / AGAINST / OUTCOMES).read_bytes()


class TestFinds:
    def test_most_of_a_known_difference_region(self):
        run = run_campaign(settings(cases=40), Path("run"))
        compared = compare_against(run)
        (version_change,) = compared.version_changes
        found = [one.later.case for one in version_change.cases if one.change is Change.BROKE]
        # Each case has the verdict of the formula, with both versions.
        assert sorted(map(str, found)) == sorted(str(o.case) for o in run.outcomes if broke(o.case))
        pool = Pool(levels=(0,), scenario=US23)
        points = spread_out(4000, 2, np.random.default_rng(0))
        truth = points[[broke(case) for case in pool.cases(points, 0)]]
        assert len(truth) > 100
        distance, _ = cKDTree(to_unit(found, 0)).query(truth)
        assert (distance <= RADIUS).mean() >= 0.9

    def test_the_old_version_is_a_campaign_of_its_own(self):
        run = run_campaign(settings(cases=10), Path("run"))
        earlier = run.read_earlier()
        assert earlier.settings.vut == "old.py:f"
        assert all(o.measures.dx_m == pytest.approx(gap_m(o.case, 0.0)) for o in earlier.outcomes)
        path = Path("run") / AGAINST / OUTCOMES
        path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:5]))
        with pytest.raises(UserError, match="against and run have different cases"):
            run.read_earlier()


def test_the_bytes_are_the_same_after_a_stop_between_the_two_versions():
    run_campaign(settings(), Path("whole"))
    run_campaign(settings(cases=10), Path("run"))
    # The batch of the old version is written first: of the new one's, half is not.
    path = Path("run") / OUTCOMES
    path.write_bytes(b"".join(path.read_bytes().splitlines(keepends=True)[:5]))
    resume_campaign(Path("run"), {"cases": 20})
    assert lines(Path("run")) == lines(Path("whole"))


class TestRefuses:
    @pytest.mark.parametrize(
        ("changes", "sentence"),
        [
            ({"in_flight": 4}, "`in_flight` and `against` cannot be combined"),
            ({"against": "traci"}, "a client that you start yourself"),
            ({"against": "new.py:f"}, "name two different versions"),
        ],
    )
    def test_what_does_not_go_together(self, changes, sentence):
        with pytest.raises(UserError, match=sentence):
            settings(**changes)

    def test_a_link_in_the_place_of_the_old_version(self):
        run_campaign(settings(cases=10), Path("run"))
        shutil.move(Path("run") / AGAINST, "elsewhere")
        (Path("run") / AGAINST).symlink_to(Path("elsewhere").absolute())
        with pytest.raises(UserError, match="link"):
            resume_campaign(Path("run"), {"cases": 20})


def test_gate_and_page_name_what_broke(call):
    command = ("campaign", "--vut", "new.py:f", "--against", "old.py:f", "--level", "0")
    more = ("--cases", "25", "--seed", "3", "--out", "run", "-q", "--json")
    said = call(*command, *more, "--gate", "regressions", "--junit", "run.xml")
    assert said.code == 1
    rows = json.loads(said.out)["against"]["transitions"]
    count = sum(row["cases"] for row in rows if row["change"] == "broke")
    assert (
        count == sum(broke(outcome.case) for outcome in RecordedCampaign(Path("run")).outcomes) > 0
    )
    assert f"gate regressions: met ({count} regression" in said.err
    assert f"<h3>Broke: {count}</h3>" in Path("run/against.html").read_text()
    assert "against.html" in Path("run/report.html").read_text()
    assert f'failures="{count}"' in Path("run.xml").read_text().split("against old.py:f")[1][:99]


def test_a_case_that_passed_and_ends_with_an_error_broke(command_line):
    text = "def f(seen):\n    if seen.v_pov_mps > 30.0:\n        raise ValueError\n    return 0.0\n"
    Path("new.py").write_text(text)
    asked = ("--vut", "new.py:f", "--against", "old.py:f", "--level", 0, "--cases", 10, "--quiet")
    code, out, err = command_line("campaign", *asked, "--out", "run")
    assert code == 0, err
    errors = sum(o.measures.end.is_error for o in RecordedCampaign(Path("run")).outcomes)
    assert 0 < errors < 10
    assert re.search(rf"of 10 shared cases {errors} worse, 0 better", out)
    assert re.search(r"safe -> vut error \(broke\)", out)
