"""Registries: what installed packages add, and what they must not."""

from __future__ import annotations

import sys

import pytest
from support import packages

from merge_sumo.errors import UserError
from merge_sumo.registry import Registry

GROUP = "merge_sumo.tools"


def registry() -> Registry[type]:
    ours = {"ours": "collections:Counter", "other": "collections:OrderedDict"}
    return Registry(
        GROUP, "tool", ours, accepts=lambda item: isinstance(item, type), contract="a class"
    )


@pytest.fixture
def install(tmp_path, monkeypatch):
    """Install a package with entry points of the group, as pip leaves it."""
    monkeypatch.syspath_prepend(tmp_path)

    def installed(package: str, entries: str, source: str = "class Tool: ..."):
        packages.install(tmp_path, package, source, GROUP, entries)
        # A folder on the path that is new to it: what was found before is not looked for again.
        extra = tmp_path / f"after-{package}"
        monkeypatch.syspath_prepend(extra)

    return installed


@pytest.mark.parametrize(
    ("entry", "source", "sentence"),
    [
        ("bad = broken:Tool", "raise SystemExit(1)", "'bad' of broken cannot be loaded"),
        ("bad = broken:Nothing", "", "'bad' of broken cannot be loaded"),
        ("bad = broken:Tool", "Tool = 3", "the tool 'bad' of broken is not a class"),
        ("ours = broken:Tool", "", "broken and merge-sumo each provide a tool 'ours'"),
    ],
)
def test_what_is_no_such_object_is_one_sentence(install, monkeypatch, entry, source, sentence):
    monkeypatch.delitem(sys.modules, "broken", raising=False)
    install("broken", entry, source)
    with pytest.raises(UserError, match=sentence):
        registry()[entry.split()[0]]


def test_a_name_of_two_packages_names_both(install):
    install("first", "theirs = first:Tool")
    install("second", "theirs = second:Tool")
    assert list(registry()) == ["ours", "other", "theirs"]
    with pytest.raises(UserError, match="first and second each provide a tool 'theirs': keep"):
        registry()["theirs"]


def test_an_unknown_name_is_one_sentence():
    with pytest.raises(UserError, match=r"unknown tool 'our': did you mean ours\? choose one of"):
        registry()["our"]


def test_the_working_folder_is_data(install, tmp_path, monkeypatch):
    install("received", "theirs = received:Tool")
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", ["", ".", *sys.path])
    assert list(registry()) == ["ours", "other"]
