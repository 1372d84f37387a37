"""A result depends on its case alone: controllers that remember earlier episodes are found."""

from __future__ import annotations

import pytest
from support.calling import invoke
from support.campaigning import campaign_settings

import merge_sumo as ms
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.repeatability import (
    REPEATS,
    cases_for_second_runs,
    read_second_runs,
    unrepeatable,
)
from merge_sumo.errors import UserError
from merge_sumo.reports.report import write_report

REMEMBERS = """
import collections
SEEN = collections.Counter()
class Vut:
    def act(self, seen):
        gap_m = seen.x_pov_m - seen.x_vut_m
        if seen.x_vut_m > -60.0 and abs(gap_m) < 15.0:
            SEEN["near"] += 1
        return -2.0 if SEEN["near"] % 7 == 3 and seen.v_vut_mps > 10.0 else 1.0
"""
"""Its module keeps a count from one episode to the next."""


@pytest.mark.slow
def test_a_controller_that_remembers_is_named_everywhere(write_vut, tmp_path):
    spec, folder = write_vut(REMEMBERS), tmp_path / "run"
    words = ("campaign", "--vut", spec, "--level", 0, "--cases", 60, "--sampler", "uniform")
    done = invoke(*words, "--out", folder, "-q")
    assert done.stdout.startswith("Not repeatable: ")
    run = RecordedCampaign(folder)
    assert len(run.outcomes) == 60
    repeats = read_second_runs(run)
    assert len(repeats) == 8
    assert [one.index for one in repeats[:4]] == list(range(4))
    differing = [one for one in repeats if not one.same]
    assert differing
    said = unrepeatable(repeats)
    assert said is not None
    assert f"8 cases ran twice, and {len(differing)} of them" in said
    assert said.split(" (case")[0] in write_report(run).read_text()
    assert said.split(" (case")[0] in ms.open_run(folder)._repr_html_()
    # check-vut finds it, too.
    checked = invoke("check-vut", spec)
    assert checked.exit_code == 1
    assert "keeps values of earlier episodes" in checked.stdout


def test_drivers_of_the_package_and_clients_that_a_user_starts_run_once(run):
    assert read_second_runs(run) == []
    assert not (run.folder / REPEATS).exists()
    assert cases_for_second_runs(run.outcomes, campaign_settings(vut="design1")) == []
    settings = campaign_settings(vut="traci")
    assert cases_for_second_runs(run.outcomes, settings) == []
    started = campaign_settings(vut="traci:python3 client.py {port}")
    assert len(cases_for_second_runs(run.outcomes, started)) == 8


def test_a_changed_file_is_refused_by_its_line(run, tmp_path):
    for name in ("campaign.json", "outcomes.jsonl"):
        (tmp_path / name).write_bytes((run.folder / name).read_bytes())
    line = '{"index":3,"differs_from_s":1.5,"end":"MERGED","failed":false,"other_verdict":true}\n'
    (tmp_path / REPEATS).write_text(line + line.replace("MERGED", "<script>"))
    with pytest.raises(UserError, match=r"line 2 of .*repeats.jsonl is damaged"):
        read_second_runs(RecordedCampaign(tmp_path))
