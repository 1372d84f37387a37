"""What surrounds a command: streams that are closed or full, limits of the system."""

from __future__ import annotations

import shlex
import shutil
import sys
from threading import Thread

import pytest
from attacks import World

from merge_sumo.errors import UserError
from merge_sumo.system.limits import check_threads

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX is needed")

CAMPAIGN = (
    "campaign --vut design1 --level 0 --cases 4 --sampler uniform --quiet --workers {workers} "
    "--out new"
)
CLOSED = ("<&-", ">&-", "2>&-", "<&- >&- 2>&-")
COMMAND = "compare run run"


@pytest.fixture
def world(run, tmp_path):
    shutil.copytree(run.folder, tmp_path / "run")
    return World(tmp_path)


def shell(world: World, command: str, streams: str = "", before: str = "") -> tuple[int, str, str]:
    """Run a command of ours by a shell, with its streams as the shell understands them."""
    run = f"{shlex.quote(sys.executable)} -m merge_sumo.cli {command} {streams}"
    script = f"{before}\n{run}\nexit $?"
    done = World(world.root, prefix=("bash", "-c", script)).run()
    for name in ("new", "new.html"):
        path = world.root / name
        shutil.rmtree(path) if path.is_dir() else path.unlink(missing_ok=True)
    return done


class TestStreams:
    @pytest.mark.slow
    def test_that_are_closed_or_full_change_nothing_else(self, world):
        code, out, _ = shell(world, COMMAND)
        assert (code, bool(out)) == (0, True)
        for streams in CLOSED:
            found, said, errors = shell(world, COMMAND, streams)
            assert found == code, (streams, errors)
            assert "Traceback" not in errors
            assert said == ("" if ">&-" in streams.split() else out)
        assert shell(world, COMMAND, "2> /dev/full")[:2] == (code, out)
        found, _, errors = shell(world, COMMAND, "> /dev/full")
        sentence = "cannot write the result to standard output: No space left on device\n"
        assert found == 2
        assert errors.endswith(sentence)
        assert "Traceback" not in errors

    def test_a_reader_that_has_gone_ends_a_command_as_it_ends_others(self, world):
        code, _, errors = shell(world, "scenario list", "| true; exit ${PIPESTATUS[0]}")
        assert (code, errors) in ((128 + 13, ""), (0, ""))  # it may have been faster


class TestLimits:
    """Each ends as without a limit, or with 2 and one sentence, and leaves nothing."""

    @pytest.mark.slow
    @pytest.mark.parametrize("limit", ["-f 1", "-n 12", "-v 1000000"])
    def test_of_files_and_memory(self, world, limit):
        code, _, errors = shell(world, CAMPAIGN.format(workers=2), before=f"ulimit {limit}")
        assert "Traceback" not in errors
        if code != 0:
            assert code == 2, errors
            assert errors.splitlines()[-1].startswith("merge-sumo: ")
        assert not [n for n in world.left_in_temporary() if not n.startswith("merge-sumo")]

    def test_of_threads_are_named(self, monkeypatch):
        def refuse(_: object) -> None:
            raise RuntimeError("can't start new thread")

        check_threads(3)
        monkeypatch.setattr(Thread, "start", refuse)
        with pytest.raises(UserError, match="no more processes or threads"):
            check_threads(3)
