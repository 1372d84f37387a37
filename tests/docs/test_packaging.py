"""What a person sees of the package before they run it: its version, types, and papers."""

from __future__ import annotations

import re
import tomllib
from importlib.metadata import version
from pathlib import Path

import merge_sumo as ms

ROOT = Path(__file__).resolve().parents[2]
CONFIG = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
PROJECT = CONFIG["project"]


def test_the_version_is_the_same_everywhere():
    assert ms.__version__ == version("merge-sumo") == PROJECT["version"]
    assert f"\nversion: {PROJECT['version']}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
    assert f"\n## {PROJECT['version']} (" in (ROOT / "CHANGELOG.md").read_text("utf-8")


def test_the_package_says_that_it_is_typed():
    assert (ROOT / "merge_sumo" / "py.typed").read_bytes() == b""
    assert "Typing :: Typed" in PROJECT["classifiers"]


def test_a_release_has_the_same_day_in_the_changelog_and_in_the_citation():
    (released,) = re.findall(
        rf"^## {re.escape(PROJECT['version'])} \((.*)\)$",
        (ROOT / "CHANGELOG.md").read_text("utf-8"),
        re.MULTILINE,
    )
    assert f"\ndate-released: {released}\n" in (ROOT / "CITATION.cff").read_text("utf-8")
