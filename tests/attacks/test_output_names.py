"""Whatever name an output gets: nothing that was there is gone, changed or followed elsewhere."""

from __future__ import annotations

import os
import shlex
import shutil
import signal
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from conftest import some
from support.calling import assert_refused
from support.campaigning import resume_campaign
from support.writers import INTO_FOLDERS, PLACES, WRITERS

import merge_sumo as ms
from merge_sumo import files
from merge_sumo.analysis.counterfactuals import AVOIDANCE, Avoidance
from merge_sumo.campaigns.campaign import SCENARIOS, case_name
from merge_sumo.campaigns.run import OUTCOMES, SETTINGS, TRAJECTORIES
from merge_sumo.errors import UserError
from merge_sumo.printable import printable, quoted
from merge_sumo.road.merge import default_net_path
from merge_sumo.scenario.scenario import US23
from merge_sumo.simulation.simulator import Simulator
from merge_sumo.training import helix
from merge_sumo.workers import Workers

NAMELESS = ["", ".", "theirs/..", "/", "/.."]
BELOW = ["file/new", "dangling/new", "loop/new", "pipe/new"]
TOO_LONG = ["é" * 128, "/".join(["d" * 200] * 30)]
ODD = [
    *("x" * 255, "é" * 127, " ", " lead", "a%41", "${HOME}", "$(id)", "`id`", ";ls", ">x", "*"),
    *("a:b", "-", "-rf", "--help", "a'b", "a\\b", "\n", "\x1b[31mred", "\x7f", "日本", "\u202eabc"),
    *("...", ".hidden", os.fsdecode(b"\xff\xfe"), "new/sub", "missing/../new8", "campaign.json"),
]


def tree(root: Path) -> dict[str, tuple[str, object]]:
    """Return everything below a folder by its kind and content; links are not followed."""
    found: dict[str, tuple[str, object]] = {}
    for path in [root, *root.rglob("*")]:
        mode = path.lstat().st_mode
        if stat.S_ISLNK(mode):
            found[str(path)] = "link", str(path.readlink())
        elif stat.S_ISREG(mode):
            found[str(path)] = "file", path.read_bytes()
        else:
            found[str(path)] = "other", stat.S_IFMT(mode)
    return found


def no_case(*_: object, **_options: object) -> None:
    raise AssertionError("a case was to run before the name was looked at")


@pytest.fixture
def no_cases(monkeypatch) -> None:
    monkeypatch.setattr(Workers, "submit", no_case)
    monkeypatch.setattr(Simulator, "__init__", no_case)


@pytest.fixture
def world(run, tmp_path, monkeypatch) -> Path:
    """Return a folder with a run, a net and things of somebody, in which commands start."""
    here = tmp_path / "world" / "deep" / "cwd"
    (here / "theirs").mkdir(parents=True)
    (here / "here").mkdir()
    shutil.copytree(run.folder, here / "run")
    shutil.copy(default_net_path(), here / "us23.net.xml")
    (here / "theirs" / "thesis").write_text("theirs")
    for name, make in {"file": "a file", "dangling": "a dangling link", "pipe": "a pipe"}.items():
        PLACES[make](here / name)
    PLACES["a link to a file"](here / "to-file")
    PLACES["a link to itself"](here / "loop")
    monkeypatch.chdir(here)
    return here


@pytest.mark.parametrize("writer", WRITERS)
def test_nothing_at_the_place_of_an_output_is_touched(
    world, no_cases, monkeypatch, command_line, writer
):
    monkeypatch.setattr(helix, "_train_in_parallel", lambda *_: [])
    command, suffix = WRITERS[writer]
    before = tree(world)
    for name, make in PLACES.items():
        make(world / f"there{suffix}")
        planted = tree(world)
        said = command_line(*shlex.split(command), f"there{suffix}")
        after = tree(world)
        assert planted.items() <= after.items(), name
        added = writer in INTO_FOLDERS and name in (
            *("a folder", "an empty folder", "a link to a folder"),
        )
        if added or (writer, name) == ("train", "an empty folder"):
            assert said.code in (0, 2), said
        else:
            assert_refused(said)
            assert after == planted, name
        for path in sorted(after.keys() - before.keys(), reverse=True):
            is_folder = Path(path).is_dir() and not Path(path).is_symlink()
            (Path(path).rmdir if is_folder else Path(path).unlink)()
    for name in (*NAMELESS, *BELOW, *TOO_LONG):
        assert_refused(command_line(*shlex.split(command), name))
        assert tree(world) == before, name


@pytest.mark.parametrize("writer", WRITERS)
def test_a_file_has_a_name_by_which_others_know_what_it_is(world, no_cases, command_line, writer):
    """A browser shows a page without `.html` as source."""
    command, suffix = WRITERS[writer]
    if not suffix:
        pytest.skip("it is a folder")
    before = tree(world)
    names = ("changes", "changes.txt", f"changes{suffix}x")
    for name in names[writer == "export cases" :]:  # a name without ending is that of a folder
        assert_refused(command_line(*shlex.split(command), name), f"end it in {suffix}")
    assert tree(world) == before


@pytest.mark.parametrize("name", some(ODD, "$(id)", "-rf", "\x1b[31mred", "日本", "new/sub"))
def test_an_odd_name_is_a_name(world, command_line, name):
    before = tree(world)
    code, _, err = command_line("export", "run", 0, f"--out={name}")
    assert code == 0, err
    new = tree(world).keys() - before.keys()
    assert before.items() <= tree(world).items()
    folder = Path(os.path.abspath(name)) / case_name(0)  # noqa: PTH100 (as the system does it)
    assert str(folder / "replay.sumocfg") in new
    assert not [path for path in new if files.TEMPORARY in path]


FILES = {"first": b"12345", "empty": b"", "last": b"67"}
KILLED = """
import os, sys
from pathlib import Path
from merge_sumo import api
from merge_sumo import files

def killed(*_):
    if [*Path(sys.argv[2]).glob(f"*/{sys.argv[3]}")]:
        os.kill(os.getpid(), 9)

os.fsync = killed
api.export(sys.argv[1], [59], out=Path(sys.argv[2]))
"""


def full(_: int) -> None:
    raise OSError(28, "No space left on device")


class TestAFolderOfFiles:
    @pytest.mark.parametrize("file", ["case.json", "replay.sumocfg"])
    def test_whose_writer_is_killed_is_not_there_and_is_written_again(self, run, tmp_path, file):
        folder = tmp_path / "out" / case_name(59)
        arguments = [sys.executable, "-c", KILLED, run.folder, folder.parent, file]
        assert subprocess.run(arguments, check=False).returncode == -signal.SIGKILL
        (left,) = folder.parent.iterdir()
        assert left.name.startswith(files.TEMPORARY)
        ms.export(run.folder, [59], out=folder.parent)
        before = tree(folder)
        assert len(before) == 8
        ms.export(run.folder, [59], out=folder.parent)
        assert tree(folder) == before, "which is the same, and stays"

    @pytest.mark.parametrize(
        "make",
        [
            *(
                PLACES[name]
                for name in ("a dangling link", "a file", "a folder", "an empty folder")
            ),
            lambda out: (out.mkdir(), (out / "first").write_text("12345")),
            lambda out: (out.mkdir(), (out / "first").symlink_to("../ours")),
        ],
    )
    def test_of_somebody_else_stays(self, tmp_path, make):
        (tmp_path / "ours").write_text("123")
        make(tmp_path / "out")
        before = tree(tmp_path)
        with pytest.raises(files.TakenError, match="out exists"):
            files.write_folder(tmp_path / "out", FILES)
        assert tree(tmp_path) == before

    def test_is_gone_when_it_cannot_be_written(self, tmp_path, monkeypatch):
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(UserError, match="No space left"):
            files.write_folder(tmp_path / "out", FILES)
        assert list(tmp_path.iterdir()) == []


class TestAFileOfOurs:
    def test_is_whole_or_as_it_was(self, tmp_path, monkeypatch):
        (tmp_path / "report").write_text("old")
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(UserError, match="No space left"):
            files.replace_own(tmp_path / "report", b"new")
        assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"report": "old"}

    @pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
    def test_whose_writer_is_killed_has_no_name_yet(self, tmp_path, share):
        content = b"x" * 100_000
        pid = os.fork()
        if pid == 0:
            with files.new_file(tmp_path / "table.csv") as file:
                file.write(content[: int(share * len(content))])
                file.flush()
                os._exit(0)
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
        (left,) = tmp_path.iterdir()
        assert left.name.startswith(files.TEMPORARY)
        files.write_new(tmp_path / "table.csv", content)
        assert (tmp_path / "table.csv").read_bytes() == content


def avoided(folder: Path) -> None:
    AVOIDANCE.write_lines(folder, [Avoidance(0, ("fsm",), None, True)])


OURS = {
    "report.html": ms.report,
    "stress.json": lambda folder: ms.stress(folder, workers=1),
    "explanations.jsonl": lambda folder: ms.explain(folder, workers=1),
    "probability.json": lambda folder: ms.probability(folder, cases=4),
    "avoidance.jsonl": avoided,
    "scenarios": lambda folder: ms.export(folder, 59),
    "exports": lambda folder: ms.export(folder, 59, file_format="csv"),
}
"""Of the names that commands write in a run folder: what does so."""
THEIRS: dict[str, Callable[[Path], object]] = {
    "a page": lambda path: path.write_text("<!doctype html><title>notes on merge-sumo</title>"),
    "a record": lambda path: path.write_text('{"mine": 1}\n'),
    **{name: PLACES[name] for name in ("a folder", "an empty folder", "a dangling link", "a pipe")},
}


@pytest.fixture
def received(world) -> Path:
    """Return a finished campaign that somebody sent."""
    return world / "run"


def cut_to_one_batch(folder: Path) -> None:
    lines = (folder / OUTCOMES).read_bytes().splitlines(keepends=True)
    (folder / OUTCOMES).write_bytes(b"".join(lines[:20]))


def moved_behind_a_link(path: Path) -> None:
    elsewhere = path.parents[1] / "theirs" / path.name
    path.rename(elsewhere)
    path.symlink_to(elsewhere)


class TestAReceivedFolder:
    @pytest.mark.parametrize(
        ("name", "make"),
        [
            *((name, moved_behind_a_link) for name in (SETTINGS, OUTCOMES, TRAJECTORIES)),
            (SCENARIOS, moved_behind_a_link),
            (f"{TRAJECTORIES}/00002.npz", lambda path: path.symlink_to("../../theirs/thesis")),
            (f"{TRAJECTORIES}/00002.npz", lambda path: path.symlink_to("../../theirs/nowhere")),
        ],
    )
    def test_with_a_link_is_not_gone_on_with(self, received, no_cases, name, make):
        cut_to_one_batch(received)
        if make is not moved_behind_a_link:
            (received / name).unlink()
        make(received / name)
        before = tree(received.parent)
        with pytest.raises(UserError, match=f"{Path(name).name}: it is a link"):
            resume_campaign(received)
        assert tree(received.parent) == before

    @pytest.mark.parametrize("kind", THEIRS)
    @pytest.mark.parametrize("name", OURS)
    def test_keeps_what_is_somebodys_in_every_place(self, received, no_cases, name, kind):
        path = received / name
        if path.is_dir():
            shutil.rmtree(path)
        path.unlink(missing_ok=True)
        THEIRS[kind](path)
        before = tree(received.parent)
        if name in ("scenarios", "exports") and kind in ("a folder", "an empty folder"):
            OURS[name](received)
            assert before.items() <= tree(received.parent).items()
        else:
            with pytest.raises(UserError, match=name):
                OURS[name](received)
            assert tree(received.parent) == before


class TestAFolderOfPolicies:
    @pytest.mark.parametrize(
        ("texts", "link", "said"),
        [
            ({"pov1.training.jsonl": "theirs"}, None, "holds other things than policies"),
            ({"manifest.json": '{"networks": {}}'}, "pov1.training.jsonl", "it is a link"),
        ],
    )
    def test_that_is_not_ours_is_not_trained_into(self, tmp_path, texts, link, said):
        for name, text in texts.items():
            (tmp_path / name).write_text(text)
        if link is not None:
            (tmp_path / link).symlink_to("elsewhere")
        before = tree(tmp_path)
        with pytest.raises(UserError, match=said):
            helix.train_library(tmp_path, ("pov1",), scenario=US23)
        assert tree(tmp_path) == before


def test_a_name_in_a_command_is_read_by_a_shell_as_it_is():
    names = [name for name in ODD if name.isprintable() or "\x1b" in name]
    words = [quoted(name) for name in names]
    command = [shutil.which("bash") or "", "-c", f"printf '%s\\0' {' '.join(words)}"]
    done = subprocess.run(command, capture_output=True, check=True)
    assert done.stdout.split(b"\0")[:-1] == [os.fsencode(name) for name in names]
    assert [printable(word) for word in words] == words


class TestTheLinkToTheNewestRun:
    @pytest.fixture
    def runs(self, tmp_path, monkeypatch) -> Path:
        monkeypatch.chdir(tmp_path)
        for name in ("a-20260101-000000", "b-20260101-000001", "mine"):
            (tmp_path / "runs" / name).mkdir(parents=True)
        return Path("runs")

    def test_moves_on_to_newer_dated_runs_only(self, runs):
        for name in ("mine", "c-20260101-000009"):
            files.link_latest(runs / name)
            assert not os.path.lexists(runs / "latest")
        for newest in ("a-20260101-000000", "b-20260101-000001"):
            files.link_latest(runs / newest)
            assert str((runs / "latest").readlink()) == newest
        assert len(list(runs.iterdir())) == 4, "nothing else is left"
