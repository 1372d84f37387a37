"""Whatever name an output gets: nothing that was there is gone, changed or followed elsewhere."""

from __future__ import annotations

import os
import shutil
import signal
import stat
import subprocess
import sys
from pathlib import Path
from unicodedata import category

import numpy as np
import pytest
from campaigning import resume_campaign
from handmade import write_run
from matplotlib.figure import Figure
from typer.testing import CliRunner

import merge_sumo as ms
from merge_sumo import cli
from merge_sumo.campaigns import campaign as conductor
from merge_sumo.campaigns.campaign import SCENARIOS, case_name
from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.run import OUTCOMES, SETTINGS, TRAJECTORIES, Run, failures, read_settings
from merge_sumo.errors import UserError
from merge_sumo.reports import figures
from merge_sumo.reports.report import REPORT, write_report
from merge_sumo.studies import probability
from merge_sumo.studies import stress as ladder
from merge_sumo.studies.counterfactuals import Avoidance, write_avoidance
from merge_sumo.system import folders
from merge_sumo.system.printable import printable, quoted
from merge_sumo.training import helix
from merge_sumo.values.scenario import US23

NAMELESS = [
    *("", ".", "./", ".//", "./.", "..", "../", "../.", "./..", "../..", "../../."),
    *("full/..", "full/../", "full/inner/..", "missing/..", "missing/../..", "./full/./.."),
]
THERE = [
    *("file.txt", "empty", "empty/", "full", "full/", "full/.", "./full", "full/notes.txt"),
    *("full/inner", "full/../empty", "dangling", "to-full", "to-file", "loop", "pipe"),
    *("../beside", "../beside/kept", "to-full/inner", "vut1.onnx", "figure.svg", "table.json"),
]
FOLDERS = [
    *("empty", "empty/", "full", "full/", "full/.", "./full", "full/inner", "full/../empty"),
    *("to-full", "../beside", "../beside/kept", "to-full/inner"),
]
NOWHERE = [
    *("file.txt/new", "file.txt/a/b", "to-file/new", "dangling/new", "loop/new", "pipe/new"),
    *("x" * 256, "é" * 128, "x" * 5000, "a/" + "y" * 256, "/".join(["d" * 200] * 30)),
]
NO_ARGUMENTS = ["nul\0byte", "half\ud800", "\0"]
"""What only Python can say."""
ODD = [
    *("x" * 255, "é" * 127, " ", "a b", " lead", "trail ", "a%b", "%41", "100%s", "${HOME}"),
    *("$HOME", "$(id)", "`id`", ";ls", "a&b", "|", ">x", "<x>", "*", "?", "[a]", "{a,b}", "a:b"),
    *("a=b", "#a", "!a", "~", "~root", "-", "--", "-rf", "--help", "a'b", 'a"b', "a\\b", "\\"),
    *("\n", "a\nb", "\r", "\t", "\x1b[31mred", "\x07", "\x7f", "日本", "é", "e\u0301", "\u202eabc"),
    *("\u200b", "\xa0", "😀", "...", ". .", ".hidden", "..a", "a..", os.fsdecode(b"\xff\xfe")),
    *("new/sub", "new/deep/er", "./new3", "full/new4", "empty/new5", "to-full/new6"),
    *("../beside/new7", "missing/../new8", "report.html", "campaign.json", "scenarios"),
]
NAMES = [*NAMELESS, *THERE, *NOWHERE, *ODD]


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


@pytest.fixture
def world(tmp_path, monkeypatch) -> Path:
    """Return a folder with planted files and links, and start in a folder inside of it."""
    here = tmp_path / "world" / "deep" / "cwd"
    for folder in (here / "full" / "inner", here / "empty", here.parent / "beside" / "kept"):
        folder.mkdir(parents=True)
    for name in ("file.txt", "full/notes.txt", "full/manifest.json", "full/inner/a", "vut1.onnx"):
        (here / name).write_text(f"mine: {name}")
    for name in ("figure.svg", "table.json", "../beside/kept/pov1.training.jsonl", "../../top"):
        (here / name).write_text(f"mine: {name}")
    for name, target in {"dangling": "nowhere", "to-full": "full", "to-file": "file.txt"}.items():
        (here / name).symlink_to(target)
    (here / "loop").symlink_to("loop")
    os.mkfifo(here / "pipe")
    monkeypatch.chdir(here)
    return tmp_path / "world"


@pytest.fixture
def guarded(world, monkeypatch):
    """Let what removes or renames tell first; what was planted is not touched, even for real."""
    planted = [Path(name) for name in tree(world)]

    def guard(name: str, module) -> None:
        real = getattr(module, name)

        def checked(path, *rest, **options):
            if options.get("dir_fd") is None and not isinstance(path, int):
                place = Path(os.path.abspath(os.fsdecode(path)))  # noqa: PTH100 (links stay)
                for other in planted:
                    assert not other.is_relative_to(place), f"{name} of {place}"
                for target in rest[:1] if name in ("rename", "replace") else ():
                    assert Path(os.path.abspath(target)) not in planted  # noqa: PTH100
            return real(path, *rest, **options)

        monkeypatch.setattr(module, name, checked)

    for name in ("unlink", "remove", "rmdir", "rename", "replace", "truncate"):
        guard(name, os)
    guard("rmtree", shutil)


@pytest.fixture
def call(guarded, command_line):
    """Return a function that runs the command line; it returns the exit code and the errors."""

    def main(*arguments: object) -> tuple[int, str]:
        code, _, err = command_line(*arguments)
        return code, err

    return main


BASH = shutil.which("bash") or "bash"
STOP = "this test runs no cases"


@pytest.fixture
def no_cases(monkeypatch) -> None:
    """Stop campaigns and reproductions where their first case would run."""

    def stop(*_: object, **_options: object) -> None:
        raise UserError(STOP)

    monkeypatch.setattr(conductor, "open_simulators", lambda *_, **__: None)
    for name in ("evaluate", "evaluate_chunks"):
        monkeypatch.setattr(conductor, name, stop)
    monkeypatch.setattr("merge_sumo.studies.sampler_study.Study.compare", stop)


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Run:
    return write_run(tmp_path_factory.mktemp("made") / "run", per_level=20)


def assert_nothing_was_touched(world: Path, write, names=NAMES) -> list[str]:
    """Write to every name; return those at which something new appeared, or in which it did.

    What appeared is removed before the next name.
    """
    appeared, before = [], tree(world)
    for name in names:
        code, said = write(name)
        after = tree(world)
        assert before.items() <= after.items(), repr(name)
        assert code in (0, 2), (name, said)
        if after != before:
            appeared.append(name)
        elif code == 2 and STOP not in said:
            assert said.startswith("merge-sumo: "), repr(name)
            assert said.count("\n") == 1, said
            assert not any(category(letter)[0] == "C" for letter in said[:-1]), said
        assert not [path for path in after if folders.TEMPORARY in path]
        for path in sorted(after.keys() - before.keys(), reverse=True):
            (Path(path).rmdir if Path(path).is_dir() else Path(path).unlink)()
    assert not set(appeared) & {*NAMELESS, *NOWHERE, *NO_ARGUMENTS}
    return appeared


def test_there_are_a_hundred_names_and_more():
    assert len(NAMES) == len(set(NAMES)) > 100


@pytest.fixture(params=["some", pytest.param("all", marks=pytest.mark.long)])
def names(request) -> list[str]:
    """Return every name, or each twelfth one of a kind: all writers ask `folders`."""
    kinds = (NAMELESS, THERE, NOWHERE, ODD)
    return [name for kind in kinds for name in kind[:: 12 if request.param == "some" else 1]]


class TestAHundredNames:
    def test_of_a_campaign_touch_nothing(self, world, call, no_cases, names):
        options = ("--vut", "design1", "--level", 0, "--cases", 2, "--sampler", "uniform", "-q")
        appeared = assert_nothing_was_touched(
            world, lambda name: call("campaign", *options, f"--out={name}"), names
        )
        assert set(appeared) == {*ODD} & {*names}

    def test_of_a_campaign_from_python_touch_nothing(self, world, guarded, no_cases, names):
        def write(name: str) -> tuple[int, str]:
            with pytest.raises(UserError) as error:
                ms.campaign("design1", level=0, cases=2, sampler="uniform", out=name)
            return 2, f"merge-sumo: {printable(str(error.value))}\n"

        appeared = assert_nothing_was_touched(world, write, [*names, *NO_ARGUMENTS])
        assert set(appeared) == {*ODD} & {*names}

    def test_of_an_export_touch_nothing(self, world, call, made, names):
        appeared = assert_nothing_was_touched(
            world, lambda name: call("export", made.folder, 1, f"--out={name}"), names
        )
        assert set(appeared) == {*ODD, *FOLDERS} & {*names}

    def test_of_a_table_touch_nothing(self, world, call, made, names):
        arguments = ("export", made.folder, 1, "--format", "csv")
        appeared = assert_nothing_was_touched(
            world, lambda name: call(*arguments, f"--out={name}"), names
        )
        assert set(appeared) >= {*ODD} & {*names}

    def test_of_openscenario_touch_nothing(self, world, call, made, names):
        names = [*(name for name in names if name not in ODD), "a:b", "${HOME}", "a%b", "a,b"]
        arguments = ("export", made.folder, 1, "--format", "openscenario")
        appeared = assert_nothing_was_touched(
            world, lambda name: call(*arguments, f"--out={name}"), names
        )
        assert {"a:b", "${HOME}", "a%b", "a,b"} <= set(appeared)

    def test_of_a_reproduction_touch_nothing(self, world, call, no_cases, names):
        arguments = ("reproduce", "--quick", "--workers=1")
        appeared = assert_nothing_was_touched(
            world, lambda name: call(*arguments, f"--out={name}"), names
        )
        assert set(appeared) == {*ODD} & {*names}

    def test_of_a_figure_touch_nothing(self, world, guarded):
        figure = Figure(figsize=(0.1, 0.1))

        def write(name: str) -> tuple[int, str]:
            try:
                figures.check_figure(Path(name))
                figures.save(figure, Path(name))
            except UserError as error:
                return 2, f"merge-sumo: {printable(str(error))}\n"
            return 0, ""

        assert assert_nothing_was_touched(world, write) == []
        named = [f"{name}.{kind}" for name in NAMES for kind in ("svg", "png")]
        appeared = assert_nothing_was_touched(world, write, named)
        assert {"a b.svg", "-rf.png", "日本.svg"} <= set(appeared)

    def test_of_fresh_cases_touch_nothing(self, world, call, run, monkeypatch, names):
        def ran(_plan, cases, *_):
            return (*np.ones((2, len(cases)), dtype=bool), 0)

        monkeypatch.setattr(probability, "run_fresh", ran)
        arguments = ("probability", run.folder, "--cases", 10)
        appeared = assert_nothing_was_touched(
            world, lambda name: call(*arguments, f"--out={name}"), names
        )
        assert {"a b", "-rf", "日本", "full/new4"} & {*names} <= set(appeared)
        assert not {"table.json", "new/sub"} & set(appeared)

    def test_of_a_training_touch_nothing(self, world, call, monkeypatch, names):
        monkeypatch.setattr(helix, "_train_in_parallel", lambda *_: [])
        appeared = assert_nothing_was_touched(
            world, lambda name: call("train", "--only", "pov1", f"--out={name}"), names
        )
        assert set(appeared) == {*ODD, "empty", "empty/", "full/../empty"} & {*names}


class TestANameOfNothing:
    @pytest.mark.parametrize("name", [*NAMELESS, "/", "//", "///", "/.", "/..", "/../.."])
    def test_is_refused_by_its_looks(self, name):
        with pytest.raises(UserError, match="write the name of what is to be made"):
            folders.check_new(Path(name))

    def test_is_refused_before_the_vut_is_opened(self, world, guarded, monkeypatch):
        monkeypatch.setattr(conductor, "open_simulators", lambda *_, **__: 1 / 0)
        for name in NAMELESS:
            with pytest.raises(UserError, match="--out is"):
                ms.campaign("design1", level=0, cases=2, out=name)


FILES = {"first": b"12345", "empty": b"", "last": b"67"}
KILLED = """
import os, sys
from pathlib import Path
from merge_sumo import api
from merge_sumo.system import folders

def killed(*_):
    if {path.name for path in Path(sys.argv[2]).iterdir()} >= {sys.argv[3]}:
        os.kill(os.getpid(), 9)

os.fsync = killed
api.export(sys.argv[1], [59], out=Path(sys.argv[2]).parent)
"""


class TestAFolderOfFiles:
    @pytest.mark.parametrize("file", ["case.json", "episode.fcd.xml", "replay.sumocfg"])
    def test_whose_writer_is_killed_is_gone_on_with_and_nothing_is_hidden(
        self, run, tmp_path, file
    ):
        folder = tmp_path / "out" / case_name(59)
        arguments = [sys.executable, "-c", KILLED, run.folder, folder, file]
        assert subprocess.run(arguments, check=False).returncode == -signal.SIGKILL
        assert [path.name for path in folder.parent.iterdir()] == [folder.name]
        ms.export(run.folder, [59], out=folder.parent)
        ms.export(run.folder, [59], out=tmp_path / "whole")
        whole = tmp_path / "whole" / folder.name
        assert {p.name: p.read_bytes() for p in folder.iterdir()} == {
            path.name: path.read_bytes() for path in whole.iterdir()
        }

    @pytest.mark.parametrize("begun", [{}, {"first": b"123"}, {"first": b"12345", "last": b"6"}])
    def test_is_gone_on_with_where_its_beginning_is_there(self, tmp_path, begun):
        for name, content in begun.items():
            (tmp_path / name).write_bytes(content)
        folders.write_folder(tmp_path, FILES)
        before = {path: path.stat() for path in tmp_path.iterdir()}
        assert {path.name: path.read_bytes() for path in before} == FILES
        folders.write_folder(tmp_path, FILES)
        assert {path: path.stat().st_mtime_ns for path in before} == {
            path: found.st_mtime_ns for path, found in before.items()
        }

    @pytest.mark.parametrize(
        "make",
        [
            lambda out: out.symlink_to("nowhere"),
            lambda out: out.write_text("theirs"),
            lambda out: (out.mkdir(), (out / "theirs").touch()),
            lambda out: (out.mkdir(), (out / "first").mkdir()),
            lambda out: (out.mkdir(), (out / "first").write_text("124")),
            lambda out: (out.mkdir(), (out / "first").write_text("123456")),
            lambda out: (out.mkdir(), (out / "first").symlink_to("../ours")),
        ],
    )
    def test_of_somebody_else_stays(self, tmp_path, make):
        (tmp_path / "ours").write_text("123")
        make(tmp_path / "out")
        before = tree(tmp_path)
        with pytest.raises(folders.TakenError, match="out exists"):
            folders.write_folder(tmp_path / "out", FILES)
        assert tree(tmp_path) == before

    def test_is_gone_when_it_cannot_be_written(self, tmp_path, monkeypatch):
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(UserError, match="No space left"):
            folders.write_folder(tmp_path / "out", FILES)
        assert list(tmp_path.iterdir()) == []


def full(_: int) -> None:
    raise OSError(28, "No space left on device")


class TestAFileOfOurs:
    def test_is_whole_or_as_it_was(self, tmp_path, monkeypatch):
        (tmp_path / "report").write_text("old")
        monkeypatch.setattr(os, "fsync", full)
        with pytest.raises(UserError, match="No space left"):
            folders.replace_own(tmp_path / "report", b"new")
        assert {p.name: p.read_text() for p in tmp_path.iterdir()} == {"report": "old"}

    @pytest.mark.parametrize("share", [0.0, 0.5, 1.0])
    def test_whose_writer_is_killed_has_no_name_yet(self, tmp_path, share):
        content = b"x" * 100_000

        def write() -> None:
            with folders.new_file(tmp_path / "table.csv") as file:
                file.write(content[: int(share * len(content))])
                file.flush()
                os._exit(0)

        pid = os.fork()
        if pid == 0:
            write()
        assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
        (left,) = tmp_path.iterdir()
        assert left.name.startswith(folders.TEMPORARY)
        folders.write_new(tmp_path / "table.csv", content)
        assert (tmp_path / "table.csv").read_bytes() == content


@pytest.fixture
def received(run, tmp_path) -> Path:
    """Return a finished campaign that somebody sent, beside a folder of ours with a file."""
    (tmp_path / "ours").mkdir()
    (tmp_path / "ours" / "bashrc").write_text("ours")
    return Path(shutil.copytree(run.folder, tmp_path / "received"))


def cut_to_one_batch(folder: Path) -> None:
    lines = (folder / OUTCOMES).read_bytes().splitlines(keepends=True)
    (folder / OUTCOMES).write_bytes(b"".join(lines[:20]))


def moved_behind_a_link(path: Path, elsewhere: Path) -> None:
    path.rename(elsewhere / path.name)
    path.symlink_to(elsewhere / path.name)


def replaced_as(place: str, content: bytes):
    """Return what writes a file as a command does."""
    return (lambda folder: folders.replace_own(folder / place, content)), place


def stressed(folder: Path) -> None:
    """Write what `rerun --stress` does; what is there is looked at before any case runs."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ladder, "RUNGS", ())
        ms.stress(folder, workers=1)


PAGE_OF_OURS = b'<!doctype html><head><meta name="generator" content="merge-sumo">'
WRITERS = {
    "report": (lambda folder: write_report(Run(folder)), REPORT),
    "against": replaced_as("against.html", PAGE_OF_OURS),
    "stress": (stressed, "stress.json"),
    "avoidance": (
        lambda folder: write_avoidance(folder, [Avoidance(0, ("fsm",), None, True)]),
        "avoidance.jsonl",
    ),
    "repeats": replaced_as("repeats.jsonl", b'{"index": 1, "same": true}\n'),
    "repair": replaced_as("repair.html", PAGE_OF_OURS),
    "search": replaced_as("benchmark.json", b'{"number_is": "a mean", "cases": 3}'),
    "explanation": (lambda folder: ms.explain(folder, workers=1), "explanations.jsonl"),
    "probability": (
        lambda folder: ms.probability(folder, out=folder / "probability.json", cases=4),
        "probability.json",
    ),
}
"""Of every file with a name of ours: what writes it into a run folder, and where."""
KINDS = {
    "page": lambda path: path.write_text("<!doctype html><title>notes on merge-sumo</title>"),
    "record": lambda path: path.write_text('{"mine": 1}\n'),
    "folder": Path.mkdir,
    "link": lambda path: path.symlink_to("../ours/bashrc"),
    "dangling link": lambda path: path.symlink_to("../ours/new"),
    "pipe": os.mkfifo,
}


class TestAReceivedFolder:
    @pytest.mark.parametrize("name", [SETTINGS, OUTCOMES, TRAJECTORIES, SCENARIOS])
    def test_with_a_link_is_not_gone_on_with(self, received, tmp_path, name, monkeypatch):
        monkeypatch.setattr(conductor, "open_simulators", lambda *_, **__: 1 / 0)
        cut_to_one_batch(received)
        moved_behind_a_link(received / name, tmp_path / "ours")
        before = tree(tmp_path)
        with pytest.raises(UserError, match=f"{name}: it is a link"):
            resume_campaign(received)
        assert tree(tmp_path) == before

    @pytest.mark.parametrize("target", ["../../ours/bashrc", "../../ours/new"])
    def test_with_a_link_among_its_trajectories_is_not_gone_on_with(
        self, received, tmp_path, monkeypatch, target
    ):
        monkeypatch.setattr(conductor, "open_simulators", lambda *_, **__: 1 / 0)
        cut_to_one_batch(received)
        (received / TRAJECTORIES / "00002.npz").unlink()
        (received / TRAJECTORIES / "00002.npz").symlink_to(target)
        before = tree(tmp_path)
        with pytest.raises(UserError, match=r"00002\.npz: it is a link"):
            resume_campaign(received)
        assert tree(tmp_path) == before

    def test_with_a_link_that_waits_for_new_settings_writes_nowhere_else(self, received, tmp_path):
        (received / f".{SETTINGS}").symlink_to("../ours/bashrc")
        with Journal.reopen(received)[0] as journal:
            journal.rewrite_settings(settings := {**Run(received).settings, "cases": 70})
        assert (tmp_path / "ours" / "bashrc").read_text() == "ours"
        assert read_settings(received) == settings

    @pytest.mark.parametrize("kind", KINDS)
    @pytest.mark.parametrize("name", WRITERS)
    def test_keeps_what_is_somebodys_in_every_place(self, received, tmp_path, name, kind):
        write, place = WRITERS[name]
        path = received / place
        path.unlink(missing_ok=True)
        KINDS[kind](path)
        before = tree(tmp_path)
        with pytest.raises(UserError, match=place):
            write(received)
        assert tree(tmp_path) == before

    @pytest.mark.parametrize("name", ["report", "stress", "avoidance", "search", "repair"])
    def test_has_what_is_ours_replaced(self, received, name):
        write, place = WRITERS[name]
        (received / place).unlink(missing_ok=True)
        write(received)
        first = (received / place).read_bytes()
        write(received)
        assert (received / place).read_bytes() == first

    @pytest.mark.parametrize("name", [SCENARIOS, "exports"])
    @pytest.mark.parametrize("file_format", ["sumo", "openscenario", "csv"])
    def test_with_a_link_for_exports_gets_none(self, received, tmp_path, name, file_format):
        if (received / name).exists():
            shutil.rmtree(received / name)
        (received / name).symlink_to("../ours")
        before = tree(tmp_path)
        said = CliRunner().invoke(cli.app, ["export", str(received), "59", "--format", file_format])
        assert isinstance(said.exception, UserError)
        assert "it is a link" in str(said.exception)
        assert tree(tmp_path) == before

    def test_keeps_a_folder_of_somebodys_in_the_place_of_a_scenario(self, received, tmp_path):
        worst, second, *_ = failures(Run(received).outcomes)
        shutil.rmtree(received / SCENARIOS)
        theirs = received / SCENARIOS / case_name(worst.index)
        theirs.mkdir(parents=True)
        (theirs / "thesis.tex").write_text("theirs")
        resume_campaign(received)
        assert tree(theirs)[str(theirs / "thesis.tex")] == ("file", b"theirs")
        assert [path.name for path in theirs.iterdir()] == ["thesis.tex"]
        assert (received / SCENARIOS / case_name(second.index) / "replay.sumocfg").is_file()


class TestAFolderOfPolicies:
    def test_that_holds_other_things_is_not_trained_into(self, tmp_path):
        (tmp_path / "pov1.training.jsonl").write_text("theirs")
        with pytest.raises(UserError, match="holds other things than policies"):
            helix.train_library(tmp_path, ("pov1",), scenario=US23)
        assert [path.name for path in tmp_path.iterdir()] == ["pov1.training.jsonl"]

    def test_whose_log_is_a_link_is_not_trained_into(self, tmp_path):
        (tmp_path / "manifest.json").write_text('{"networks": {}}')
        (tmp_path / "pov1.training.jsonl").symlink_to("elsewhere")
        with pytest.raises(UserError, match="it is a link"):
            helix.train_library(tmp_path, ("pov1",), scenario=US23)
        assert not (tmp_path / "elsewhere").exists()

    def test_that_was_begun_is_gone_on_with(self, tmp_path, monkeypatch):
        asked: list[Path] = []

        def train(folder: Path, *_: object) -> list:
            asked.append(folder)
            return []

        monkeypatch.setattr(helix, "_train_in_parallel", train)
        for _ in range(2):
            helix.train_library(tmp_path / "new", ("pov1",), scenario=US23)
            (tmp_path / "new" / "pov1.training.jsonl").write_text("{}\n")
        assert asked == [tmp_path / "new"] * 4, "two levels, twice"


@pytest.mark.parametrize("name", [name for name in ODD if name.isprintable() or "\x1b" in name])
def test_a_name_in_a_command_is_read_by_a_shell_as_it_is(name):
    done = subprocess.run(
        [BASH, "-c", f"printf '%s|' {quoted(name)} end"], capture_output=True, check=True
    )
    assert done.stdout == os.fsencode(name) + b"|end|"
    assert printable(quoted(name)) == quoted(name)


class TestTheLinkToTheNewestRun:
    @pytest.fixture
    def runs(self, tmp_path, monkeypatch) -> Path:
        monkeypatch.chdir(tmp_path)
        for name in ("a-20260101-000000", "b-20260101-000001", "mine"):
            (tmp_path / "runs" / name).mkdir(parents=True)
        return Path("runs")

    def test_is_made_and_moves_on_to_newer_ones_only(self, runs):
        for newest in ("a-20260101-000000", "b-20260101-000001"):
            folders.link_latest(runs / newest)
            assert str((runs / "latest").readlink()) == newest
        folders.link_latest(runs / "a-20260101-000000")
        assert str((runs / "latest").readlink()) == "b-20260101-000001"
        assert len(list(runs.iterdir())) == 4, "nothing of ours is left beside it"

    @pytest.mark.parametrize("target", ["mine", "../elsewhere", "/", "a-20260101-000000/x"])
    def test_of_somebody_else_stays(self, runs, target):
        (runs / "latest").symlink_to(target)
        folders.link_latest(runs / "b-20260101-000001")
        assert str((runs / "latest").readlink()) == target

    @pytest.mark.parametrize("make", [Path.mkdir, lambda path: path.write_text("mine")])
    def test_does_not_take_the_place_of_a_file_or_a_folder(self, runs, make):
        make(runs / "latest")
        folders.link_latest(runs / "b-20260101-000001")
        assert not (runs / "latest").is_symlink()

    @pytest.mark.parametrize(
        "folder", ["runs/mine", "elsewhere/a-20260101-000000", "runs/c-20260101-000009"]
    )
    def test_is_not_made_for_what_has_a_name_of_its_own_or_is_not_there(self, runs, folder):
        folders.link_latest(Path(folder))
        assert not os.path.lexists(runs / "latest")
