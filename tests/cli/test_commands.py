"""The command line as a whole: groups of options, help, and how it stops."""

from __future__ import annotations

import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from support.calling import commands, invoke

import merge_sumo as ms
from merge_sumo import cli, config
from merge_sumo.errors import UserError

COMMANDS = commands()
PANELS = {
    "Find failures": {"campaign", "probability", "run"},
    "Inspect cases": {"explain", "export", "replay", "report"},
    "Compare versions": {"compare", "rerun"},
    "Bring your own": {"check-vut", "scenario", "train", "vuts"},
    "Research": {"benchmark", "reproduce", "truth"},
}


def test_sixteen_commands_stand_in_five_panels():
    panels: dict[str, set[str]] = {}
    for name, command in cli.app.resolved_commands().items():
        if not name.startswith("-"):
            group: Any = command.group
            panels.setdefault(group[0].name, set()).add(name)
    assert panels == PANELS
    assert sum(map(len, panels.values())) == 16


class TestOptions:
    @pytest.mark.parametrize("name", COMMANDS)
    def test_fit_in_70_lines_and_all_but_the_most_used_have_one_line(self, name, monkeypatch):
        monkeypatch.setenv("COLUMNS", "100")
        shown = invoke(*name.split(), "--help").output
        assert shown.count("\n") <= 70
        assert f"Example:  merge-sumo {name}" in shown
        for line in shown.split("More options")[1].splitlines()[1:-1]:
            assert re.match(r"│ --.*\S {2,}\w", line)

    @pytest.mark.parametrize(
        ("name", "flags"),
        [
            ("campaign", "--vut --follow-up --deadline --vut-memory --tolerate --gate --quiet -q"),
            ("run", "--x --v --psi --headway-ahead --headway-behind --from --case --at --json"),
            ("explain", "--param"),
            ("export", "--format"),
        ],
    )
    def test_keep_the_flags_that_are_shorter_than_their_fields(self, name, flags):
        shown = invoke(name, "--help").output.split()
        assert set(flags.split()) <= set(shown)

    @pytest.mark.parametrize(
        ("words", "sentence"),
        [
            (["campaign", "--samplr", "gpr"], "Did you mean --sampler?"),
            (["campain"], 'Did you mean "campaign"?'),
            (["campaign", "--cases", "few"], "--cases"),
            (["campaign", "--seed", "1", "--seed", "2"], "--seed specified multiple times"),
            (["run", "--at", "x_pov0_m"], "give NAME=NUMBER"),
            (["vuts", "so", "many"], "Unused Tokens: ['so', 'many']."),
            (["campaign", "design1", "--fail-when", "-x < 3"], "-x is not a measure"),
            (["campaign", "--no-such-option", "3"], "--no-such-option"),
            (["campaign", "design1", "more"], "more"),
        ],
    )
    def test_that_are_mistyped_are_named(self, words, sentence):
        said = invoke(*words)
        assert said.exit_code == 2
        assert sentence in str(said.exception)

    def test_give_a_command_all_cores_and_python_none(self, monkeypatch):
        seen = {}

        def truth(**options):
            seen.update(options)
            raise UserError("enough")

        monkeypatch.setattr(ms, "truth", truth)
        for words, workers in ((), "auto"), (("--workers", "2"), 2):
            invoke("truth", "design1", *words)
            assert seen["workers"] == workers
        assert config.GroundTruth("design1").workers == 1


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
class TestCtrlC:
    """On a terminal: what is drawn is ended, the cursor is shown, and the exit code is 130."""

    @pytest.mark.slow
    def test_leaves_the_terminal_as_it_was(self, tmp_path):
        text, code = on_a_terminal("campaign --vut design1 --level 0 --cases 4000", tmp_path)
        assert code == 130
        assert text.count("\x1b[?25l") == text.count("\x1b[?25h") > 0
        last = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", text).replace("\r", "").splitlines()[-1]
        assert last.startswith("stopped")
        assert "Traceback" not in text


def on_a_terminal(command: str, folder: Path) -> tuple[str, int]:
    """Run a command on a pseudo-terminal until Ctrl-C; return its output and its exit code."""
    ours, theirs = os.openpty()
    process = subprocess.Popen(
        [sys.executable, "-m", "merge_sumo.cli", *command.split()],
        cwd=folder,
        env={**os.environ, "MERGE_SUMO_CACHE": str(folder / "cache"), "TERM": "xterm"},
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        start_new_session=True,
    )
    os.close(theirs)
    shown, pressed = b"", False
    while True:
        try:
            some = os.read(ours, 65536)
        except OSError:  # the other end is closed
            break
        if not some:
            break
        shown += some
        if b"cases" in shown and not pressed:
            pressed = True
            os.kill(process.pid, signal.SIGINT)
    os.close(ours)
    return shown.decode(errors="replace"), process.wait(timeout=600)


def test_help_whose_reader_has_gone_ends_as_other_programs_do():
    reader, writer = os.pipe()
    os.close(reader)
    command = [sys.executable, "-m", "merge_sumo.cli", "campaign", "--help"]
    done = subprocess.run(command, stdout=writer, stderr=subprocess.PIPE, check=False)
    os.close(writer)
    assert (done.returncode, done.stderr) == (128 + signal.SIGPIPE, b"")
