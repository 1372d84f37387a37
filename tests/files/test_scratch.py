"""Temporary folders: those of processes that are gone are removed, and nothing else."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest

from merge_sumo import files
from merge_sumo.files import PREFIX, ScratchFolder

BESIDE = (
    "import sys, time\n"
    "from merge_sumo.files import ScratchFolder\n"
    "made = ScratchFolder()\n"
    "open(made.name + '/some', 'w').close()\n"
    "print(made.name, flush=True)\n"
    "time.sleep(600.0)\n"
)


@pytest.fixture
def temporary(tmp_path, monkeypatch):
    """Give an own folder for temporary files, in which this process has made nothing yet."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    monkeypatch.setattr(files, "YOUNG_S", 0.0)
    files._remove_remains.cache_clear()
    return tmp_path


@pytest.fixture
def beside(temporary):
    """Give another process, and the scratch folder that it has made."""
    command = [sys.executable, "-c", BESIDE]
    environment = {**os.environ, "TMPDIR": str(temporary)}
    with subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield process, Path(process.stdout.readline().rstrip())
        process.kill()


def test_of_a_process_that_was_killed_is_removed_by_the_next(temporary, beside):
    process, folder = beside
    assert folder.parent == temporary
    process.send_signal(signal.SIGKILL)
    process.wait()
    assert (folder / "some").is_file()
    with ScratchFolder() as name:
        assert list(temporary.iterdir()) == [Path(name)]
    assert not list(temporary.iterdir())


def test_of_a_process_that_goes_on_stays(beside):
    _, folder = beside
    with ScratchFolder():
        assert (folder / "some").is_file()


def test_nothing_else_is_removed(temporary, tmp_path_factory):
    elsewhere = tmp_path_factory.mktemp("elsewhere")
    (elsewhere / "kept").touch()
    name = f"{PREFIX}abcd123"
    (temporary / f"{name}0").symlink_to(elsewhere)
    (temporary / f"{name}1").touch()
    for other in (f"{name}-own", "merge-sumo-abcd1234", "merge-sumo-results", f"x{name}2"):
        (temporary / other).mkdir()
    before = sorted(temporary.iterdir())
    with ScratchFolder():
        pass
    assert sorted(temporary.iterdir()) == before
    assert (elsewhere / "kept").is_file()


@pytest.mark.skipif(os.geteuid() != 0, reason="root gives a folder to another user")
def test_what_another_user_left_stays(temporary):
    theirs = temporary / f"{PREFIX}abcd1234"
    theirs.mkdir()
    os.chown(theirs, 65534, 65534)
    with ScratchFolder():
        assert theirs.is_dir()
