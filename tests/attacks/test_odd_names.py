"""Odd names of VUT files and folders, and terminals that cannot show them."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from support.calling import assert_refused
from support.campaigning import campaign_settings, run_campaign
from support.handmade import write_run
from support.plans import plan_for

from merge_sumo.campaigns import campaign as conductor
from merge_sumo.campaigns.campaign import export_case
from merge_sumo.campaigns.run import Run
from merge_sumo.errors import UserError
from merge_sumo.printable import printable
from merge_sumo.reports.report import write_report
from merge_sumo.simulation.simulator import Simulator

VUT = "def drive(seen):\n    return 1.0\n"
NOT_UTF8 = os.fsdecode(b"vut-\xff\xfe")
NASTY = "a%41 b,c\n$(id)'\"\\ \x1b[31m日é" + os.fsdecode(b"\xff")
ASCII = {"LC_ALL": "C", "PYTHONIOENCODING": "ascii:strict"}


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Run:
    return write_run(tmp_path_factory.mktemp("made") / "run", per_level=20)


def on_ascii(*arguments: object) -> tuple[int, str, str]:
    done = subprocess.run(
        [sys.executable, "-m", "merge_sumo.cli", *map(str, arguments)],
        capture_output=True,
        check=False,
        env={**os.environ, **ASCII},
    )
    return done.returncode, done.stdout.decode("latin-1"), done.stderr.decode("latin-1")


class TestAVutFile:
    @pytest.mark.slow
    def test_with_an_odd_name_is_tested(self, call, tmp_path):
        name = "日本 %41, ${HOME}"
        (tmp_path / f"{name}.py").write_text(VUT)
        options = ("--level", 0, "--cases", 2, "--sampler", "uniform", "--workers", 1)
        code, out, err = call("campaign", "--vut", f"{name}.py:drive", *options, "--json")
        assert code == 0, err
        assert "\x1b" not in out + err
        assert Path(json.loads(out)["report"]).is_file()
        (folder,) = (tmp_path / "runs").glob("*-*")
        assert folder.name.isascii()
        assert Run(folder).settings.vut == f"{name}.py:drive"
        code, out, err = call("check-vut", f"{name}.py:drive")
        assert code == 0, out + err

    @pytest.mark.parametrize("vut", [f"{NOT_UTF8}.py:drive", f"traci:{NOT_UTF8} {{port}}"])
    def test_with_a_name_that_is_no_text_is_refused_before_it_is_loaded(self, call, tmp_path, vut):
        (tmp_path / f"{NOT_UTF8}.py").write_text("raise SystemExit('it was loaded')")
        assert_refused(
            call("campaign", "--vut", vut, "--cases", 2),
            "merge-sumo: --vut is ",
            "bytes that are not UTF-8",
        )
        assert [path.suffix for path in tmp_path.iterdir()] == [".py"]


class TestATerminal:
    @pytest.mark.slow
    def test_of_any_encoding_shows_results_in_folders_of_any_name(self, made, tmp_path):
        folder = Path(shutil.copytree(made.folder, tmp_path / NASTY))
        code, out, err = on_ascii("compare", folder, folder)
        assert code == 0, err
        assert " 0 broke" in out.splitlines()[0]
        assert err == ""
        assert "\x1b" not in out
        assert "\\x1b[31m" in out
        code, out, err = on_ascii("export", folder, 0)
        assert (code, err) == (0, "")
        assert out.count("\n") == 1
        assert (folder / "scenarios" / "case-00000" / "replay.sumocfg").is_file()


def test_what_is_printed_moves_no_cursor_and_keeps_letters_of_all_languages():
    assert printable("日本 é\xa0Ω😀") == "日本 é\xa0Ω😀"
    assert printable("a\nb\r\x1b[2J\x9b\u202e\u2028\ud800\0") == (
        "a\\nb\\r\\x1b[2J\\x9b\\u202e\\u2028\\ud800\\x00"
    )


class TestSumo:
    def test_says_so_where_there_is_no_folder_for_temporary_files(self, tmp_path, monkeypatch):
        monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "gone"))
        with pytest.raises(UserError, match="set TMPDIR to a folder"):
            Simulator(plan_for("design1", corridors=1))


@pytest.mark.parametrize("size", [3990, 4096])
def test_a_path_works_or_is_too_long_before_the_first_case(tmp_path, monkeypatch, size):
    folder = tmp_path
    while size - len(os.fsencode(folder)) > 400:
        folder /= "d" * 200
    left = size - len(os.fsencode(folder)) - 2
    folder = folder / ("r" * (left // 2)) / ("r" * (left - left // 2))
    assert len(os.fsencode(folder)) == size
    monkeypatch.setattr(conductor, "open_simulators", lambda *_, **__: 1 / 0)
    settings = campaign_settings(vut="design1", cases=99_999)
    with pytest.raises((UserError, ZeroDivisionError)) as error:
        run_campaign(settings, folder)
    assert list(tmp_path.iterdir()) == []
    if error.type is ZeroDivisionError:
        assert size < 4020
        written = write_run(folder, per_level=10)
        export_case(written, 0, folder / "scenarios" / "case-99999")
        assert write_report(written).is_file()
    else:
        assert "File name too long" in str(error.value)
        assert size > 4000
