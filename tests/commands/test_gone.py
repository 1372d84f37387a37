"""A command or an option that is gone is answered with its successor, in one sentence."""

from __future__ import annotations

import re

import pytest
from typer.core import TyperGroup
from typer.main import get_command
from typer.testing import CliRunner

from merge_sumo.cli import app
from merge_sumo.commands import gone
from merge_sumo.errors import UserError


def commands() -> set[str]:
    group = get_command(app)
    assert isinstance(group, TyperGroup)
    return set(group.commands)


def refused(*arguments: str) -> str:
    with pytest.raises(UserError) as refusal:
        CliRunner().invoke(app, list(arguments), catch_exceptions=False)
    return str(refusal.value)


def test_a_command_and_an_option_that_are_gone_name_their_successors(monkeypatch):
    monkeypatch.setattr(gone, "COMMANDS", {"old": "`new` does it"})
    monkeypatch.setattr(gone, "OPTIONS", {"--old": "--new does it", "--vut": "never said"})
    assert refused("old", "runs/a") == "the command old is gone: `new` does it"
    said = "the option --old is gone: --new does it"
    assert refused("campaign", "--vut", "design2", "--old=3") == said
    assert refused("campaign", "--old") == said


def test_the_contest_of_samplers_is_named_where_it_was():
    for arguments in (("uniform", "gpr"), ("--quick",), ("--problems", "table")):
        assert "`python tools/benchmark`" in refused("benchmark", *arguments)


@pytest.mark.parametrize("name", gone.COMMANDS)
def test_no_command_is_both_here_and_gone(name):
    assert name not in commands()


@pytest.mark.parametrize("successor", [*gone.COMMANDS.values(), *gone.OPTIONS.values()])
def test_a_successor_is_a_command_that_is_here(successor):
    here = commands()
    assert not successor.endswith(".")
    for command in re.findall(r"`merge-sumo ([\w-]+)", successor):
        assert command in here
