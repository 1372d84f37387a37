"""What surrounds a command: streams that are closed or full, limits of the system."""

from __future__ import annotations

import shlex
import shutil
import sys
from threading import Thread

import pytest
from attacks import World
from conftest import some

from merge_sumo.errors import UserError
from merge_sumo.system.limits import check_threads

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="a shell of POSIX is needed")

CAMPAIGN = (
    "campaign --vut design1 --level 0 --cases 4 --sampler uniform --quiet --workers {workers} "
    "--out new"
)
CLOSED = ("<&-", ">&-", "2>&-", "<&- >&- 2>&-")
COMMANDS = {
    "--version": 0,
    "--help": 0,
    "campaign --help": 0,
    "scenario list": 0,
    "vuts": 0,
    "campaign --vut nonsense": 2,
    CAMPAIGN.format(workers=1): 0,
    CAMPAIGN.format(workers=2): 0,
    "campaign --vut own.py:Vut --level 0 --cases 4 --out new": 0,
    "run --vut design1 --level 0 --x -200 --v 30 --out new": 0,
    "report run": 0,
    "compare run run": 0,
    "export run --format csv --out new": 0,
    "rerun run": 0,
    "check-vut design1": 0,
    "probability run --cases 20 --out new": 0,
    "truth --vut design1 --level 0 --cases 100": 0,
    "benchmark --vut design1 --level 0 --cases 8 --seeds 1 --samplers uniform --truth-cases 100": 0,
}
"""Commands, and the exit codes that they have."""


@pytest.fixture
def world(run, tmp_path):
    shutil.copytree(run.folder, tmp_path / "run")
    (tmp_path / "own.py").write_text("class Vut:\n    def act(self, seen):\n        return 0.5\n")
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
    @pytest.mark.parametrize("command", some(COMMANDS, "scenario list"))
    def test_that_are_closed_change_nothing_else(self, world, command):
        code, out, _ = shell(world, command)
        assert COMMANDS[command] == code
        for streams in CLOSED:
            found, said, errors = shell(world, command, streams)
            assert found == code, (streams, errors)
            assert "Traceback" not in errors
            if ">&-" not in streams.split() and "--version" in command:
                assert said == out

    @pytest.mark.slow
    @pytest.mark.parametrize("command", some(COMMANDS, "scenario list"))
    def test_a_result_that_cannot_be_written_is_an_error(self, world, command):
        code, out, _ = shell(world, command)
        found, _, errors = shell(world, command, "> /dev/full")
        if not out:
            assert found == code
            return
        assert found == 2
        assert errors.endswith(
            "cannot write the result to standard output: No space left on device\n"
        )
        assert "Traceback" not in errors

    @pytest.mark.slow
    @pytest.mark.parametrize("command", some(COMMANDS, "scenario list"))
    def test_a_full_standard_error_costs_what_is_said_there_alone(self, world, command):
        code, out, _ = shell(world, command)
        found, said, _ = shell(world, command, "2> /dev/full")
        assert found == code
        assert bool(said) == bool(out)

    def test_a_reader_that_has_gone_ends_a_command_as_it_ends_others(self, world):
        code, _, errors = shell(world, "scenario list", "| true; exit ${PIPESTATUS[0]}")
        assert (code, errors) in ((128 + 13, ""), (0, ""))  # it may have been faster


class TestLimits:
    """Each ends as without a limit, or with 2 and one sentence, and leaves nothing."""

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "limit",
        some(
            [
                *(f"-f {blocks}" for blocks in (0, 1, 100)),
                *(f"-n {files}" for files in (5, 6, 7, 8, 10, 12, 14, 16, 18, 20, 22, 24)),
                *(f"-v {size}" for size in (500_000, 1_000_000, 2_000_000, 2_200_000)),
            ],
            "-f 1",
            "-v 1000000",
        ),
    )
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
