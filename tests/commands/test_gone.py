"""A command that is gone is answered with its successor, in one sentence."""

from __future__ import annotations

import re

import pytest
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

from merge_sumo.cli import app
from merge_sumo.commands import application
from merge_sumo.errors import UserError


def commands() -> set[str]:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    return set(group.commands)


def test_a_command_that_is_gone_names_its_successor(monkeypatch):
    monkeypatch.setattr(application, "GONE", {"old": "`new` does it"})
    with pytest.raises(UserError, match=r"^the command old is gone: `new` does it$"):
        CliRunner().invoke(app, ["old", "runs/a"], catch_exceptions=False)


@pytest.mark.parametrize("name", application.GONE)
def test_no_command_is_both_here_and_gone(name):
    assert name not in commands()


@pytest.mark.parametrize("successor", application.GONE.values())
def test_a_successor_is_a_command_that_is_here(successor):
    here = commands()
    assert not successor.endswith(".")
    for command in re.findall(r"`merge-sumo ([\w-]+)", successor):
        assert command in here
