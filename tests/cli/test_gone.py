"""A command that is gone is answered with its successor, in one sentence."""

from __future__ import annotations

import re

import pytest
from support.calling import commands, invoke

from merge_sumo import cli

NAMES = {name.split()[0] for name in commands()}


def test_a_command_that_is_gone_names_its_successor(monkeypatch):
    monkeypatch.setattr(cli, "GONE", {"old": "`new` does it"})
    assert (
        str(invoke("old", "runs/a").exception) == "the command old no longer exists: `new` does it"
    )


@pytest.mark.parametrize("name", cli.GONE)
def test_no_command_is_both_here_and_gone(name):
    assert name not in NAMES


@pytest.mark.parametrize("successor", cli.GONE.values())
def test_a_successor_is_a_command_that_is_here(successor):
    assert not successor.endswith(".")
    for command in re.findall(r"`merge-sumo ([\w-]+)", successor):
        assert command in NAMES
