"""Recorded cases again with a changed VUT."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import pytest

from merge_sumo.campaigns.run import Run, failures
from merge_sumo.studies.rerun import rerun, settings_today

SEVERE = ("contact", "conflict")


@pytest.fixture
def folder(run, tmp_path) -> Path:
    return Path(shutil.copytree(run.folder, tmp_path / "campaign"))


class TestTheSameVut:
    def test_gives_every_verdict_and_score_again(self, run):
        found = rerun(run, settings_today(run))
        assert [o.measures for o in found.after] == [o.measures for o in run.outcomes]
        assert found.changed == []
        assert found.compared.worse(0.0) == []

    def test_is_said_to_change_nothing(self, command_line, folder):
        code, out, _ = command_line("rerun", folder, "3", "7")
        assert code == 0
        assert "no verdict changed" in out
        assert "it is not worse" in out


class TestAChangedVut:
    def test_that_stands_times_out_in_all_cases_and_is_worse(
        self, command_line, folder, tmp_path, monkeypatch
    ):
        monkeypatch.chdir(tmp_path)
        Path("still.py").write_text("def f(seen):\n    return -4.0\n")
        first, second = (outcome.index for outcome in failures(Run(folder).outcomes)[:2])
        code, out, _ = command_line("rerun", folder, first, second, "--vut", "still.py:f", "--json")
        told = json.loads(out)
        assert code == 1
        assert {
            (c["index"], c["severity_before"] in SEVERE, c["end_after"]) for c in told["changed"]
        } == {
            (first, True, "TIMEOUT"),
            (second, True, "TIMEOUT"),
        }
        assert any("in no case" in why for why in told["why"])
        assert any(
            "B has an error or timeout in 2 of 2 cases, A in 0 of 2" in w for w in told["why"]
        )

    def test_that_is_better_says_what_it_fixed(self, command_line, folder):
        fixed = [o.index for o in failures(Run(folder).outcomes)]
        code, out, _ = command_line("rerun", folder, "--vut", "design2")
        assert code == 0
        assert all(
            re.search(rf"case {index}: con\w+ -> (safe|harsh) \(fixed\)", out) for index in fixed
        )
        assert f"merge-sumo run --case {folder} " in out


@pytest.mark.parametrize(
    ("arguments", "part"),
    [
        (("60",), "has no case 60"),
        (("--vut", "design9"), "design9"),
        (("--tolerance", "-1"), "--tolerance"),
    ],
)
def test_bad_use_is_refused(command_line, folder, arguments, part):
    code, out, err = command_line("rerun", folder, *arguments)
    assert (code, out) == (2, "")
    assert part in err


def test_another_net_is_refused(command_line, folder):
    settings = json.loads((folder / "campaign.json").read_text())
    settings.pop("sha256")
    settings["net_sha256"] = "0"
    (folder / "campaign.json").write_text(json.dumps(settings))
    code, _, err = command_line("rerun", folder)
    assert (code, "another net" in err) == (2, True)
