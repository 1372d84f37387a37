"""A result depends on its case alone: controllers that remember or draw lots are found out."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
from support.calling import invoke
from support.campaigning import campaign_settings, run_campaign

import merge_sumo as ms
from merge_sumo.campaigns.repeats import (
    REPEATS,
    Repeat,
    chosen_again,
    read_repeats,
    unrepeatable,
)
from merge_sumo.campaigns.run import Run
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import UserError
from merge_sumo.records import to_plain
from merge_sumo.reports.report import write_report
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.workers import open_workers

SHY = """
    def act(self, seen):
        gap_m = seen.x_pov_m - seen.x_vut_m
        if seen.x_vut_m > -60.0 and abs(gap_m) < 15.0:
            {remember}
        return -2.0 if {remembered} and seen.v_vut_mps > 10.0 else 1.0
"""
OWN = SHY.format(remember="self.shy = True", remembered="self.shy")
IN_ITS_MODULE = "import collections\nSEEN = collections.Counter()\nclass Vut:\n" + SHY.format(
    remember="SEEN['near'] += 1", remembered="SEEN['near'] % 7 == 3"
)


@pytest.fixture
def vut(tmp_path):
    def write(source: str) -> str:
        path = tmp_path / f"vut{len(list(tmp_path.glob('*.py')))}.py"
        path.write_text(source, encoding="utf-8")
        return f"{path}:Vut"

    return write


def campaign(spec: str, folder: Path, workers: int = 1, **settings) -> Run:
    given = {"vut": spec, "levels": (0,), "cases": 60, "sampler": "uniform", **settings}
    with open_workers(workers) as there:
        return run_campaign(CampaignSettings(**{"scenario": US23, **given}), folder, workers=there)


@pytest.mark.slow
def test_what_remembers_is_said_everywhere_but_is_no_other_case(vut, tmp_path):
    spec, folder = vut(IN_ITS_MODULE), tmp_path / "run"
    arguments = ["campaign", "--vut", spec, "--level", "0", "--cases", "60", "--sampler"]
    arguments += ["uniform"]
    done = invoke(*arguments, "--out", str(folder), "-q")
    assert done.stdout.startswith("Not repeatable: ")
    run = Run(folder)
    assert len(run.outcomes) == 60
    repeats = read_repeats(run)
    assert len(repeats) == 8
    assert [one.index for one in repeats[:4]] == list(range(4))
    differing = [one for one in repeats if not one.same]
    assert differing
    assert {one.first for one in differing} == {"vut"}
    said = unrepeatable(repeats)
    assert said is not None
    assert f"{len(differing)} of 8 cases" in said
    assert said.split(" (case")[0] in write_report(run).read_text()
    assert said.split(" (case")[0] in ms.open_run(folder)._repr_html_()
    # check-vut finds it, too.
    checked = invoke("check-vut", spec)
    assert checked.exit_code == 1
    assert "keeps something from earlier episodes" in checked.stdout


def test_drivers_of_the_package_run_once_and_a_client_that_nobody_starts_is_not_waited_for(run):
    assert read_repeats(run) == []
    assert not (run.folder / REPEATS).exists()
    assert chosen_again(run.outcomes, campaign_settings(vut="design1")) == []
    settings = campaign_settings(vut="traci")
    assert chosen_again(run.outcomes, settings) == []
    started = campaign_settings(vut="traci:python3 client.py {port}")
    assert len(chosen_again(run.outcomes, started)) == 8


HONEST = to_plain(Repeat(3, 1.5, "vut", End.MERGED, failed=False, other_verdict=True))


@pytest.mark.parametrize(
    "change",
    [
        {"index": 60},
        {"differs_from_s": 1e300},
        {"first": "<script>"},
    ],
)
def test_a_file_that_somebody_changed_is_refused_by_its_line(run, tmp_path, change):
    folder = tmp_path / "run"
    folder.mkdir()
    for name in ("campaign.json", "outcomes.jsonl"):
        (folder / name).write_bytes((run.folder / name).read_bytes())
    opened = Run(folder)
    (folder / REPEATS).write_text(json.dumps(HONEST) + "\n")
    assert read_repeats(opened) == [Repeat(3, 1.5, "vut", End.MERGED, False, True)]
    (folder / REPEATS).write_text(json.dumps(HONEST) + "\n" + json.dumps({**HONEST, **change}))
    with pytest.raises(UserError, match=r"line 2 of .*repeats.jsonl is not as it was written"):
        read_repeats(opened)
