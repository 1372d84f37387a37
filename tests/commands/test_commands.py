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
import typer

from merge_sumo import cli
from merge_sumo.commands.application import PANELS
from merge_sumo.options import GROUPS


def commands() -> dict[str, Any]:
    """Return all commands by what a person types."""
    found = {}
    waiting: list[tuple[str, Any]] = [("", typer.main.get_command(cli.app))]
    while waiting:
        name, one = waiting.pop()
        below = getattr(one, "commands", {})
        waiting += [(f"{name} {part}".strip(), command) for part, command in below.items()]
        if not below:
            found[name] = one
    return found


COMMANDS = commands()


def test_seventeen_commands_stand_in_five_panels():
    application: Any = typer.main.get_command(cli.app)
    panels: dict[str | None, tuple[str, ...]] = {}
    for name in application.list_commands(None):
        panel = application.commands[name].rich_help_panel
        panels[panel] = (*panels.get(panel, ()), name)
    assert panels == PANELS
    assert sum(map(len, panels.values())) == 17


class TestOptions:
    def test_of_a_campaign_are_at_most_28_with_json_and_help(self):
        options = [p.opts[0] for p in COMMANDS["campaign"].params if p.name != "context"]
        assert len({*options, "--help"}) <= 28, options

    @pytest.mark.parametrize("name", COMMANDS)
    def test_stand_in_groups(self, name):
        options = [p for p in COMMANDS[name].params if p.param_type_name == "option"]
        groups = [p.rich_help_panel for p in options if p.name != "help"]
        assert groups == sorted(groups, key=GROUPS.index)


@pytest.mark.skipif(not hasattr(os, "openpty"), reason="needs a pseudo-terminal")
class TestCtrlC:
    """On a terminal: what is drawn is ended, the cursor is shown, and the exit code is 130."""

    @pytest.mark.slow
    @pytest.mark.parametrize(
        "command",
        [
            "campaign --vut design1 --level 0 --cases 4000 --out run",
            pytest.param(
                "truth --vut design1 --level 0 --cases 9000 --workers 1", marks=pytest.mark.long
            ),
        ],
        ids=lambda command: command.split()[0],
    )
    def test_leaves_the_terminal_as_it_was(self, tmp_path, command):
        text, code = on_a_terminal(command, tmp_path)
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
