"""A folder that somebody sent is data: what it names is not run, unless a person says so."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from calling import assert_refused
from campaigning import campaign_settings, resume_campaign, run_campaign
from conftest import some

from merge_sumo.campaigns.ownership import check_own_code
from merge_sumo.campaigns.store import CHECKSUM, SETTINGS, read_settings
from merge_sumo.errors import UserError
from merge_sumo.system.hashing import sha256_of
from merge_sumo.system.resources import cache_folder
from merge_sumo.system.trust import RUNS, Code, doubt, note_own

VUT = """
import pathlib
pathlib.Path(__file__).with_name("it-ran").touch()
def Vut(seen):
    return {answer}
"""
COMMAND = "{python} -c \"import pathlib; pathlib.Path('{file}').touch()\" {{port}}"
TAR = shutil.which("tar")


@pytest.fixture(autouse=True)
def of_a_user(tmp_path, monkeypatch):
    """Work as a user with a cache of their own."""
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "mine"))


@pytest.fixture
def stranger(monkeypatch, tmp_path):
    """Return a function after which whoever is here is somebody else."""
    return lambda: monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "theirs"))


@dataclass(frozen=True)
class Project:
    """A folder with a VUT that leaves a file where it ran, and a campaign of it in `run`."""

    folder: Path

    @property
    def run(self) -> Path:
        return self.folder / "run"

    @property
    def vut(self) -> Path:
        return self.folder / "my_vut.py"

    def ran(self) -> bool:
        """Return whether the VUT ran since this was asked last."""
        telltale = self.folder / "it-ran"
        found = telltale.exists()
        telltale.unlink(missing_ok=True)
        return found

    def change(self, answer: float = 0.5) -> None:
        self.vut.write_text(VUT.format(answer=answer))


def project(folder: Path, answer: float = 1.0, *, vut: str = "my_vut.py:Vut") -> Project:
    """Make a project in a folder, and run its campaign there."""
    made = Project(folder)
    folder.mkdir()
    made.change(answer)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        settings = campaign_settings(vut=vut, cases=12, batch=6, sampler="uniform")
        run_campaign(settings, Path("run"))
    assert made.ran()
    return made


@pytest.fixture(scope="module")
def kept(tmp_path_factory) -> Iterator[Project]:
    """Return a project whose owner's cache is beside it."""
    folder = tmp_path_factory.mktemp("kept")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MERGE_SUMO_CACHE", str(folder / "mine"))
        yield project(folder / "project")


@pytest.fixture
def mine(kept, monkeypatch) -> Iterator[Project]:
    """Return a project of the user who is here, and put it back in the end."""
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(kept.folder.parent / "mine"))
    monkeypatch.chdir(kept.folder)
    before = {path: path.read_bytes() for path in kept.folder.rglob("*") if path.is_file()}
    yield kept
    for path, content in before.items():
        if not path.is_file() or path.read_bytes() != content:
            path.write_bytes(content)


@pytest.fixture
def own(tmp_path, monkeypatch) -> Project:
    """Return a project that was made for one test, by the user who is here."""
    made = project(tmp_path / "own")
    monkeypatch.chdir(made.folder)
    return made


def edit(run: Path, **changes: object) -> None:
    settings = json.loads((run / SETTINGS).read_text())
    settings.pop(CHECKSUM)  # who sends a folder can compute it, too
    (run / SETTINGS).write_text(json.dumps(settings | changes))


def refuses(said: tuple[int, str, str], *words: str) -> bool:
    code, _, err = said
    known = all(word in err for word in ("--trust-vut", *words))
    return code == 2 and known and err.count("\n") == 1


def commands(run: Path, out: Path) -> list[tuple[object, ...]]:
    """Return the commands that run the VUT of a folder."""
    return [
        ("campaign", "--resume", run, "--quiet"),
        ("rerun", run, 0),
        ("explain", run),
        ("stress", run),
        ("run", "--case", run, 0),
        ("compare-runs", run, run),
        ("probability", run, "--cases", 10, "--out", out / "p.json"),
        ("failures-per-merge", run, "--traffic", "exid-5", "--out", out / "f.json"),
    ]


class TestAReceivedFolder:
    def test_runs_none_of_its_code_by_any_command(self, tmp_path, mine, stranger, command_line):
        stranger()
        for command in commands(mine.run, tmp_path):
            assert refuses(command_line(*command), "was not made here"), command
        assert not mine.ran()

    def test_is_reported_exported_and_replayed_without_its_code(
        self, tmp_path, mine, stranger, command_line
    ):
        stranger()
        out = tmp_path / "out"
        assert command_line("report", mine.run)[0] == 0
        for form in ("sumo", "openscenario", "csv"):
            done = command_line("export", mine.run, 0, "--format", form, "--out", out / form)
            assert done[0] == 0
        assert command_line("replay", out / "sumo" / "case-00000")[0] == 0
        assert command_line("compare-runs", mine.run, mine.run, "--no-rerun")[0] == 0
        assert not mine.ran()

    def test_may_be_trusted(self, mine, stranger):
        stranger()
        resume_campaign(mine.run, trust=True)
        assert mine.ran()

    def test_whose_controller_is_named_again_is_trusted(self, mine, stranger):
        stranger()
        resume_campaign(mine.run, given={"vut": "my_vut.py:Vut"})
        assert mine.ran()

    def test_that_was_trusted_is_asked_about_again_when_its_code_changes(
        self, mine, stranger, command_line
    ):
        stranger()
        resume_campaign(mine.run, trust=True)
        resume_campaign(mine.run)
        assert mine.ran()
        mine.change()
        assert refuses(command_line("rerun", mine.run), "was not begun here", "my_vut.py")
        assert not mine.ran()

    def test_starts_no_command(self, tmp_path, mine, stranger, command_line):
        file = tmp_path / "started"
        edit(mine.run, vut="traci", vut_command=COMMAND.format(python=sys.executable, file=file))
        for becomes in (lambda: None, stranger):
            becomes()
            for command in commands(mine.run, tmp_path):
                assert refuses(command_line(*command)), command
        assert not file.exists()

    @pytest.mark.parametrize("vut", ["level0", "design1", "sumo:IDM"])
    def test_runs_what_is_of_this_package_or_of_sumo(self, tmp_path, stranger, vut):
        settings = campaign_settings(vut=vut, cases=2, sampler="uniform", batch=2)
        run = run_campaign(settings, tmp_path / "run")
        stranger()
        assert len(resume_campaign(run.folder).outcomes) == 2


def by_copytree(mine: Project, to: Path) -> None:
    shutil.copytree(mine.folder, to)


def by_tar(mine: Project, to: Path) -> None:
    to.mkdir()
    packed = subprocess.run([TAR, "-c", "."], cwd=mine.folder, capture_output=True, check=True)
    subprocess.run([TAR, "-xp"], cwd=to, input=packed.stdout, check=True)


def by_links(mine: Project, to: Path) -> None:
    shutil.copytree(mine.folder, to, copy_function=os.link)


def by_git(mine: Project, to: Path) -> None:
    git = ("git", "-c", "user.name=x", "-c", "user.email=x")
    for command in (("init", "-q"), ("add", "-f", "."), ("commit", "-qm", "x")):
        subprocess.run([*git, *command], cwd=mine.folder, check=True)
    subprocess.run([*git, "clone", "-q", str(mine.folder), str(to)], check=True)
    shutil.rmtree(mine.folder / ".git")


class TestACopyOfOnesOwnRun:
    """As when a published run comes back with other code beside it: the same user, the same key."""

    @pytest.mark.parametrize("copied", some([by_copytree, by_tar, by_links, by_git], by_tar))
    def test_with_other_code_beside_it_runs_nothing(
        self, copied, tmp_path, mine, monkeypatch, command_line
    ):
        copied(mine, tmp_path / "copy")
        copy = Project(tmp_path / "copy")
        copy.vut.unlink()
        copy.change()
        monkeypatch.chdir(copy.folder)
        for command in commands(Path("run"), tmp_path):
            assert refuses(command_line(*command), "was not made here"), command
        assert not copy.ran()
        assert not mine.ran()

    def test_run_from_the_folder_of_other_code_runs_nothing(
        self, tmp_path, mine, monkeypatch, command_line
    ):
        other = Project(tmp_path / "other")
        other.folder.mkdir()
        other.change()
        monkeypatch.chdir(other.folder)
        for command in commands(mine.run, tmp_path):
            assert refuses(command_line(*command), f"was begun in {mine.folder}"), command
        assert not other.ran()

    @pytest.mark.slow
    @pytest.mark.parametrize("over", ["it", "what is left of it"])
    def test_that_is_unpacked_over_it_runs_nothing(
        self, over, own, tmp_path, command_line, monkeypatch
    ):
        by_copytree(own, tmp_path / "copy")
        Project(tmp_path / "copy").change()
        packed = tmp_path / "published.tar"
        subprocess.run([TAR, "-cf", packed, "."], cwd=tmp_path / "copy", check=True)
        if over != "it":
            shutil.rmtree(own.folder)
            own.folder.mkdir()
        subprocess.run([TAR, "-xpf", packed], cwd=own.folder, check=True)
        monkeypatch.chdir(own.folder)
        for command in commands(own.run, tmp_path):
            assert refuses(command_line(*command)), command
        assert not own.ran()

    def test_that_takes_its_name_runs_nothing(self, own, tmp_path, command_line, monkeypatch):
        by_copytree(own, tmp_path / "copy")
        own.folder.rename(tmp_path / "away")
        (tmp_path / "copy").rename(own.folder)
        own.change()
        monkeypatch.chdir(own.folder)
        assert refuses(command_line("rerun", own.run), "is another folder")
        assert not own.ran()

    @pytest.mark.slow
    def test_behind_a_link_is_the_folder_that_it_leads_to(self, tmp_path, mine, command_line):
        link = tmp_path / "link"
        link.symlink_to(mine.run)
        assert command_line("rerun", link, 0)[0] == 0
        assert mine.ran()
        shutil.copytree(mine.run, tmp_path / "copy")
        link.unlink()
        link.symlink_to(tmp_path / "copy")
        assert refuses(command_line("rerun", link, 0), "was not made here")
        assert not mine.ran()


class TestAFolderOfOnesOwn:
    @pytest.mark.slow
    def test_runs_its_code_by_every_command(self, tmp_path, mine, command_line):
        for command in commands(mine.run, tmp_path):
            code, _, err = command_line(*command)
            assert code in (0, 1), err
            assert mine.ran(), command

    @pytest.mark.slow
    def test_runs_ones_own_changed_code_where_a_changed_vut_is_what_is_wanted(
        self, own, command_line
    ):
        own.change()
        code, out, err = command_line("rerun", own.run)
        assert code in (0, 1), err
        assert "now: " in out
        assert own.ran()
        assert_refused(
            command_line("campaign", "--resume", own.run, "--quiet"), "vut_files.my_vut.py differs"
        )

    @pytest.mark.slow
    def test_that_was_moved_is_asked_about(self, own, tmp_path, command_line, monkeypatch):
        own.folder.rename(tmp_path / "moved")
        monkeypatch.chdir(tmp_path / "moved")
        assert refuses(command_line("rerun", "run", 0), "was moved")
        assert command_line("rerun", "run", 0, "--trust-vut")[0] == 0
        assert command_line("rerun", "run", 0, "--vut", "my_vut.py:Vut")[0] == 0

    @pytest.mark.slow
    def test_is_ones_own_from_anywhere_where_the_controller_has_its_whole_path(
        self, tmp_path, command_line, monkeypatch
    ):
        own = project(tmp_path / "own", vut=f"{tmp_path / 'own' / 'my_vut.py'}:Vut")
        monkeypatch.chdir(tmp_path)
        assert command_line("campaign", "--resume", own.run, "--quiet")[0] == 0
        assert command_line("rerun", own.run, 0)[0] == 0
        own.change()
        assert command_line("rerun", own.run, 0)[0] in (0, 1)

    @pytest.mark.parametrize("place", [".", "run"])
    def test_with_changed_code_inside_is_asked_about(self, tmp_path, place):
        (tmp_path / "run").mkdir()
        for file in ("run/record", f"{place}/code"):
            (tmp_path / file).write_text("as it was")
        path = str(tmp_path / place / "code")
        code = Code(("vut", None, None), {path: sha256_of(Path(path))}, "")
        note_own(tmp_path / "run", tmp_path / "run", "record", code, begun=True)
        assert doubt(tmp_path / "run", "record", code) is None
        Path(path).write_text("changed")
        why = doubt(tmp_path / "run", "record", code)
        assert (why is None) == (place == ".")
        assert why is None or why.startswith("holds ")

    def test_with_changed_code_that_others_can_write_is_asked_about(self, own, command_line):
        own.change()
        own.vut.chmod(0o666)
        assert refuses(command_line("rerun", own.run, 0), "others can write it")
        assert not own.ran()

    @pytest.mark.parametrize(
        "forged",
        [
            {"vut": "theirs.py:Vut"},
            {"vut": "onnx:theirs.onnx"},
            {"vut": "fmu:theirs.fmu"},
            {"vut": "an_installed_name"},
            {"vut": "traci", "vut_command": "theirs"},
            {"vut": "level0", "pov": "my_vut.py:Vut"},
            {"pov": "my_vut.py:Vut"},
        ],
    )
    def test_that_somebody_changed_is_a_strangers(self, mine, forged, monkeypatch):
        (mine.folder / "theirs.py").write_text(VUT.format(answer=0.0))
        edit(mine.run, **forged, vut_files=None)
        with pytest.raises(UserError, match=r"names another controller.*--trust-vut"):
            resume_campaign(mine.run)
        (mine.folder / "theirs.py").unlink()
        assert not mine.ran()

    @pytest.mark.parametrize("at", [0, 100, -1])
    def test_is_a_strangers_where_the_cache_says_something_else(self, mine, at):
        (entry,) = (cache_folder() / RUNS).iterdir()
        content = bytearray(entry.read_bytes())
        try:
            spoilt = bytearray(content)
            spoilt[at] ^= 1
            for other in (spoilt, content[:at], b"", b"{}"):
                entry.write_bytes(other)
                with pytest.raises(UserError, match="was not made here"):
                    check_own_code(mine.run, read_settings(mine.run), {})
        finally:
            entry.write_bytes(content)
        check_own_code(mine.run, read_settings(mine.run), {})

    def test_whose_cache_is_gone_is_asked_about(self, mine, monkeypatch, tmp_path):
        (tmp_path / "file").touch()
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "file"))
        with pytest.raises(UserError, match=r"is not known to be yours.*--trust-vut"):
            resume_campaign(mine.run)
        assert not mine.ran()

    def test_without_a_cache_is_run_and_asked_about_later(self, monkeypatch, tmp_path):
        (tmp_path / "file").touch()
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "file"))
        made = project(tmp_path / "one")
        monkeypatch.chdir(made.folder)
        with pytest.raises(UserError, match="--trust-vut"):
            resume_campaign(made.run)

    def test_has_nothing_in_it_that_a_copy_could_carry_along(self, mine):
        assert "seal" not in read_settings(mine.run)


def replace_vut(folder: str) -> None:
    """Put other code into the place of a VUT, as who can write the folder but not the file."""
    Path(folder, "my_vut.py").unlink()
    Path(folder, "my_vut.py").write_text(VUT.format(answer=0.0))


class TestTwoUsers:
    """A second account of this machine, which can write where both work."""

    def test_who_puts_another_folder_under_the_name_of_a_run_has_none_of_it_run(
        self, common, other_account, command_line, monkeypatch
    ):
        own = project(common / "own")
        own.folder.chmod(0o777)

        def swap(name: str) -> None:
            Path(name, "run").rename(Path(name, "was"))
            shutil.copytree(Path(name, "was"), Path(name, "run"))
            replace_vut(name)

        other_account(swap, str(own.folder))
        monkeypatch.chdir(own.folder)
        assert refuses(command_line("rerun", own.run, 0), "is another folder")
        assert not own.ran()

    def test_who_changes_the_code_of_a_run_has_none_of_it_run(
        self, common, other_account, command_line, monkeypatch
    ):
        own = project(common / "own")
        own.folder.chmod(0o777)

        other_account(replace_vut, str(own.folder))
        monkeypatch.chdir(own.folder)
        assert refuses(command_line("rerun", own.run, 0), "others can write it")
        assert not own.ran()

    def test_who_keeps_the_cache_of_another_vouches_for_nothing(
        self, common, other_account, command_line, monkeypatch
    ):
        own = project(common / "own")

        def plant(name: str, key: bytes) -> None:
            Path(name).mkdir()
            Path(name, "key").write_bytes(key)
            Path(name, "key").chmod(0o600)

        other_account(plant, str(common / "cache"), b"k" * 32)
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(common / "cache"))
        monkeypatch.chdir(own.folder)
        said = command_line("rerun", own.run, 0)
        assert refuses(said, f"belongs to {other_account.name}")
        assert not own.ran()
