"""One case on its own: on the command line, from Python, and live in sumo-gui."""

from __future__ import annotations

import json
import os
from pathlib import Path

import numpy as np
import pytest
from support.calling import assert_refused

STALEMATE = ("--level", "2", "--x", "-294.5", "--v", "34.125", "--psi", "0.6")
SAFE = ("--level", "0", "--x", "-300", "--v", "34")


class TestTheCommand:
    def test_shows_the_stalemate_of_the_shipped_folder(self, command_line):
        code, out, _ = command_line("run", "--vut", "design2", *STALEMATE)
        assert code == 1
        head, *said = [line.strip() for line in out.splitlines()[:8]]
        assert head.startswith("case: late brake, contact at ")
        assert "7.7 s   last way out: full braking or full acceleration" in said
        assert "8.1 s   the VUT brakes: 20.3 to 16.5 m/s, 0.4 s too late" in said
        assert "impact speed" in out

    def test_keeps_the_case_as_a_folder_that_replays(self, command_line, tmp_path):
        _, ran, _ = command_line("run", "--vut", "design2", *SAFE, "--out", tmp_path / "kept")
        code, out, _ = command_line("replay", tmp_path / "kept")
        _, *told, replayed = out.splitlines()
        assert (code, told) == (0, ran.splitlines()[1 : len(told) + 1])
        rows = _rows(tmp_path / "kept")
        assert replayed == f"identical: {rows} rows of x, y and speed"
        view = (tmp_path / "kept" / "view.settings.xml").read_text()
        assert 'vehicle_exaggeration="1"' in view, "cars are to scale"

    def test_begins_its_table_before_the_conflict(self, command_line):
        _, whole, _ = command_line("run", "--vut", "design2", *STALEMATE, "--json")
        _, out, _ = command_line("run", "--vut", "design2", *STALEMATE, "--from", "-2.7")
        begins, _, *table = out.splitlines()[-9:]
        assert begins == "from 6.3 s, 2.7 s before the contact at 9.0 s"
        assert [line.split()[0] for line in table] == [f"{6.3 + s:.1f}" for s in range(7)]
        motion = json.loads(whole)["motion"]
        assert [line.split()[1] for line in table] == [f"{car[0][0]:.1f}" for car in motion[63::10]]
        _, told, _ = command_line("run", "--vut", "design2", *STALEMATE, "--from", "-3", "--json")
        assert told == whole, "the record is of all of it"

    def test_says_the_same_of_a_recorded_case_as_its_campaign(self, command_line, run):
        code, out, _ = command_line("run", "--case", run.folder, "7", "--json")
        told = json.loads(out)
        was = run.outcome(7)
        assert told["score"] == was.measures.score
        assert (np.array(told["motion"]) == run.trajectory(7).whole).all()
        assert code == (1 if was.failed else 0)

    def test_runs_a_vut_in_this_process_for_a_debugger(self, command_line, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        Path("mine.py").write_text("import os\ndef f(seen):\n    raise ValueError(os.getpid())\n")
        _, out, _ = command_line("run", "--vut", "mine.py:f", *SAFE, "--debug")
        assert f"ValueError: {os.getpid()}" in out
        _, out, _ = command_line("run", "--vut", "mine.py:f", *SAFE)
        assert "ValueError: " in out
        assert f"ValueError: {os.getpid()}" not in out

    @pytest.mark.parametrize(
        ("arguments", "part"),
        [
            (SAFE, "no VUT is named: set --vut"),
            (("--vut", "my_vut.py", *SAFE), "my_vut.py:NAME"),
            (("--vut", "design2", "--x", "-300"), "--v is missing"),
            (("--vut", "design2", *SAFE, "--psi", "0.2"), "--psi is not a coordinate of"),
            (("--vut", "design2", *SAFE[2:], "--level", "all"), "--level all"),
            (("--case", "nowhere", "3"), "is not a run folder: cannot read"),
        ],
    )
    def test_is_refused_in_a_sentence(self, command_line, arguments, part):
        assert_refused(command_line("run", *arguments), part)

    def test_without_a_display_no_window_opens(self, command_line, monkeypatch):
        # Without a name FOX would take display 0, which another test may have.
        monkeypatch.setenv("DISPLAY", ":4711")
        code, _, err = command_line("run", "--vut", "design2", *SAFE, "--gui")
        assert (code, "needs a desktop" in err) == (2, True)


def _rows(folder: Path) -> int:
    return (folder / "episode.fcd.xml").read_text().count("<vehicle ")


class TestInSumoGui:
    @pytest.fixture
    def opened(self, monkeypatch) -> list[dict[str, bytes]]:
        """Return what sumo-gui is opened on, instead of opening it."""
        found: list[dict[str, bytes]] = []

        def note(folder: Path, from_s: float | None, **_: bool) -> None:
            found.append({file.name: file.read_bytes() for file in folder.iterdir()})

        monkeypatch.setattr("merge_sumo.sumo.replay.open_gui", note)
        return found

    def test_the_replay_opens_when_the_case_has_ended(self, command_line, opened, tmp_path):
        start = ("run", "--vut", "design2", *STALEMATE, "--gui")
        code, out, err = command_line(*start)
        assert code == 1
        assert "late brake" in out
        assert "close the window" in err
        command_line(*start, "--out", tmp_path / "kept")
        kept = {file.name: file.read_bytes() for file in (tmp_path / "kept").iterdir()}
        assert opened == [kept, kept]
        code, replayed, _ = command_line("replay", tmp_path / "kept")
        assert (code, "identical" in replayed) == (0, True)
