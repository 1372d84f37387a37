"""Settings are data; their plan is made once, and asks a VUT once what it is."""

from __future__ import annotations

from collections import Counter

import pytest
from campaigning import campaign_settings

import merge_sumo as ms
from merge_sumo.campaigns.plan import resolve
from merge_sumo.errors import UserError
from merge_sumo.vuts import factory
from merge_sumo.vuts.host import hosted

VUT = """
from pathlib import Path
with Path(__file__).with_suffix(".log").open("a") as log:
    log.write("loaded")

def f(seen):
    return 0.5
"""


@pytest.fixture
def spec(tmp_path):
    (tmp_path / "my.py").write_text(VUT, encoding="utf-8")
    return f"{tmp_path / 'my.py'}:f"


@pytest.fixture
def calls(monkeypatch):
    """Count the processes of VUTs that start, and the factories of VUTs that look for theirs."""
    counts: Counter[str] = Counter()
    start, find = hosted.Host._start, hosted.hosted_vut

    def counted_start(self):
        counts["processes"] += 1
        start(self)

    def counted_find(spec, options, alike):
        counts["found"] += 1
        return find(spec, options, alike)

    monkeypatch.setattr(hosted.Host, "_start", counted_start)
    monkeypatch.setattr(factory, "hosted_vut", counted_find)
    return counts


def test_settings_load_no_vut_and_start_no_process(spec, calls):
    campaign_settings(vut=spec, cases=4, sampler="uniform")
    campaign_settings(vut="nowhere.py:f", cases=4, sampler="uniform")
    assert not calls


def test_a_plan_asks_a_vut_once_what_it_is(spec, calls):
    plan = resolve(campaign_settings(vut=spec, cases=4, sampler="uniform"))
    assert calls == {"processes": 1, "found": 1}
    assert plan.workers(2) == 2
    plan.for_cases(4)
    assert calls == {"processes": 1, "found": 1}


def test_a_campaign_starts_a_vut_to_ask_it_and_to_let_it_drive(spec, calls, tmp_path):
    run = ms.campaign(spec, level=0, cases=8, batch=4, seed=1, out=tmp_path / "run")
    assert len(run.cases) == 8
    # The factory of the plan, and that of the plan with the log of the campaign.
    assert calls == {"processes": 2, "found": 2}


def test_settings_of_a_vut_that_nobody_knows_have_no_plan():
    with pytest.raises(UserError, match="there is no VUT 'desgin2'"):
        resolve(campaign_settings(vut="desgin2"))
