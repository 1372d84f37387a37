"""Whatever name an output gets: nothing that was there is gone, changed or followed elsewhere."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Never

import pytest
from conftest import some
from support.calling import assert_refused
from support.campaigning import resume_campaign
from support.writers import INTO_FOLDERS, PLACES, WRITERS, tree

import merge_sumo as ms
from merge_sumo import files
from merge_sumo.campaigns.campaign import SCENARIOS, case_name
from merge_sumo.campaigns.recorded import OUTCOMES, SETTINGS, TRAJECTORIES
from merge_sumo.errors import UserError
from merge_sumo.printable import printable, quoted
from merge_sumo.road.loader import default_net_path
from merge_sumo.simulation.simulator import Simulator
from merge_sumo.training import helix
from merge_sumo.workers import Workers

REFUSED = ["", ".", "theirs/..", "/", "file/new", "dangling/new", "loop/new", "pipe/new"]
TOO_LONG = ["é" * 128, "/".join(["d" * 200] * 30)]
NOT_UTF8 = os.fsdecode(b"\xff\xfe")
ODD = [
    *("x" * 255, " lead", "a%41", "${HOME}", "$(id)", ";ls", "*", "a:b", "-rf", "--help", "a'b"),
    *("a\\b", "\n", "\x1b[31mred", "日本", "\u202eabc", ".hidden", NOT_UTF8, "new/sub"),
]


def no_case(*_: object, **_options: object) -> None:
    raise AssertionError("a case was to run before the name was looked at")


def no_training(*_: object) -> None:
    raise UserError("a training was to begin")


@pytest.fixture
def no_cases(monkeypatch) -> None:
    monkeypatch.setattr(Workers, "submit", no_case)
    monkeypatch.setattr(Simulator, "__init__", no_case)
    monkeypatch.setattr(helix, "_train_in_parallel", no_training)


@pytest.fixture
def cwd(run, tmp_path, monkeypatch) -> Path:
    """Return a folder with a run, a net and things of another user, in which commands start."""
    here = tmp_path / "above" / "deep" / "cwd"
    (here / "theirs").mkdir(parents=True)
    shutil.copytree(run.folder, here / "run")
    shutil.copy(default_net_path(), here / "us23.net.xml")
    (here / "theirs" / "thesis").write_text("theirs")
    for name, make in {"file": "a file", "dangling": "a dangling link", "pipe": "a pipe"}.items():
        PLACES[make](here / name)
    PLACES["a link to itself"](here / "loop")
    monkeypatch.chdir(here)
    return here


def remove(path: Path) -> None:
    """Remove a file, link or folder; a link is not followed."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


@pytest.mark.parametrize("writer", WRITERS)
def test_nothing_at_the_place_of_an_output_is_touched(cwd, no_cases, command_line, writer):
    command, suffix = WRITERS[writer]
    words, there = shlex.split(command), cwd / f"there{suffix}"
    before = tree(cwd)
    for name, make in PLACES.items():
        make(there)
        planted = tree(cwd)
        said = command_line(*words, there.name)
        after = tree(cwd)
        assert planted.items() <= after.items(), name
        adds = writer in INTO_FOLDERS or (writer, name) == ("train", "an empty folder")
        if adds and there.is_dir():
            assert said.code in (0, 2), said
        else:
            assert_refused(said)
            assert after == planted, name
        for path in after.keys() - planted.keys():
            remove(Path(path))
        remove(there)
    wrong = ["changes", "changes.txt", f"changes{suffix}x"] if suffix else []
    if writer == "export cases":
        wrong.remove("changes")  # that is a folder
    for name in wrong:
        assert_refused(command_line(*words, name), f"must end in {suffix}")
    for name in (*REFUSED, *TOO_LONG):
        assert_refused(command_line(*words, name))
    assert tree(cwd) == before


@pytest.mark.parametrize("name", some(ODD, "$(id)", "-rf", "\x1b[31mred", "日本", "new/sub"))
def test_an_odd_name_is_a_name(cwd, command_line, name):
    before = tree(cwd)
    code, _, err = command_line("export", "run", 0, f"--out={name}")
    assert code == 0, err
    after = tree(cwd)
    assert before.items() <= after.items()
    assert str(cwd / name / case_name(0) / "replay.sumocfg") in after
    assert not [path for path in after if files.TEMPORARY in path]


@pytest.mark.parametrize("name", ODD)
def test_a_name_in_a_command_is_one_word_of_a_shell_and_moves_no_cursor(name):
    word = quoted(name)
    command = [shutil.which("bash") or "", "-c", f"printf %s {word}"]
    output = subprocess.run(command, capture_output=True, check=True).stdout
    assert output.decode() == printable(name)
    assert printable(word) == word


def test_what_is_printed_moves_no_cursor_and_keeps_letters_of_all_languages():
    assert printable("日本 é\xa0Ω😀") == "日本 é\xa0Ω😀"
    assert printable("a\nb\r\x1b[2J\x9b\u202e\u2028\ud800\0") == (
        "a\\nb\\r\\x1b[2J\\x9b\\u202e\\u2028\\ud800\\x00"
    )


@pytest.mark.parametrize("vut", [f"{NOT_UTF8}.py:drive", f"traci:{NOT_UTF8} {{port}}"])
def test_a_controller_with_a_name_that_is_no_text_is_refused_before_it_is_loaded(call, vut):
    Path(f"{NOT_UTF8}.py").write_text("raise SystemExit('it was loaded')")
    said = call("campaign", "--vut", vut, "--cases", 2)
    assert_refused(said, "merge-sumo: --vut is ", "bytes that are not UTF-8")


def die(*_: object, **_options: object) -> Never:
    os._exit(9)


def write_file(path: Path) -> None:
    files.write_new(path, b"12345")


def write_folder(path: Path) -> None:
    files.write_folder(path, {"first": b"12345", "empty": b""})


@pytest.mark.parametrize("write", [write_file, write_folder])
def test_a_writer_that_is_killed_leaves_no_name_and_the_next_one_writes(tmp_path, write):
    pid = os.fork()
    if pid == 0:
        os.fsync = os.link = die
        write(tmp_path / "out")
        os._exit(0)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 9
    (left,) = tmp_path.iterdir()
    assert left.name.startswith(files.TEMPORARY)
    write(tmp_path / "out")
    assert len(list(tmp_path.iterdir())) == 2
    if write is write_folder:
        before = tree(tmp_path)
        write(tmp_path / "out")
        assert tree(tmp_path) == before, "the same files stay"


def test_a_full_disk_leaves_what_was_there(tmp_path, monkeypatch):
    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    (tmp_path / "report").write_text("old")
    before = tree(tmp_path)
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(UserError, match="No space left"):
        files.replace_own(tmp_path / "report", b"new")
    with pytest.raises(UserError, match="No space left"):
        write_folder(tmp_path / "out")
    assert tree(tmp_path) == before


def test_a_folder_with_other_files_than_those_to_be_written_stays(tmp_path):
    (tmp_path / "first").symlink_to("../theirs")
    before = tree(tmp_path)
    with pytest.raises(files.TakenError, match="exists"):
        write_folder(tmp_path)
    assert tree(tmp_path) == before


OURS: dict[str, Callable[[Path], object]] = {
    "report.html": ms.report,
    "stress.json": lambda folder: ms.stress(folder, workers=1),
    "probability.json": lambda folder: ms.probability(folder, cases=4),
    "scenarios": lambda folder: ms.export(folder, 59),
    "exports": lambda folder: ms.export(folder, 59, file_format="csv"),
}
"""Of the names that commands write in a run folder: what does so."""
THEIRS: dict[str, Callable[[Path], object]] = {
    "a page": lambda path: path.write_text("<!doctype html><title>notes on merge-sumo</title>"),
    "a record": lambda path: path.write_text('{"mine": 1}\n'),
    **{name: PLACES[name] for name in ("a folder", "an empty folder", "a dangling link", "a pipe")},
}


def replace_by_link(path: Path) -> None:
    elsewhere = path.parents[1] / path.name
    path.rename(elsewhere)
    path.symlink_to(elsewhere)


class TestARunFolderOfOthers:
    @pytest.mark.parametrize("name", [SETTINGS, OUTCOMES, SCENARIOS, f"{TRAJECTORIES}/00002.npz"])
    def test_with_a_link_is_not_resumed(self, cwd, no_cases, name):
        folder = cwd / "run"
        lines = (folder / OUTCOMES).read_bytes().splitlines(keepends=True)
        (folder / OUTCOMES).write_bytes(b"".join(lines[:20]))
        replace_by_link(folder / name)
        before = tree(cwd)
        with pytest.raises(UserError, match=f"{Path(name).name}: it is a link"):
            resume_campaign(folder)
        assert tree(cwd) == before

    @pytest.mark.parametrize("kind", THEIRS)
    @pytest.mark.parametrize("name", OURS)
    def test_keeps_their_files_in_every_place(self, cwd, no_cases, name, kind):
        path = cwd / "run" / name
        remove(path)
        THEIRS[kind](path)
        before = tree(cwd)
        if name in ("scenarios", "exports") and path.is_dir():
            OURS[name](cwd / "run")
            assert before.items() <= tree(cwd).items()
        else:
            with pytest.raises(UserError, match=name):
                OURS[name](cwd / "run")
            assert tree(cwd) == before


def test_the_link_to_the_newest_run_moves_to_newer_dated_runs_only(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    runs = Path("runs")
    for name in ("a-20260101-000000", "b-20260101-000001", "mine"):
        (runs / name).mkdir(parents=True)
    for name in ("mine", "c-20260101-000009"):
        files.link_latest(runs / name)
        assert not os.path.lexists(runs / "latest")
    for newest in ("a-20260101-000000", "b-20260101-000001"):
        files.link_latest(runs / newest)
        assert str((runs / "latest").readlink()) == newest
