"""The page of a first campaign shows what its command prints, and has a paragraph on each line."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

PAGE = Path(__file__).resolve().parents[2] / "docs" / "tutorials" / "first-campaign.md"
TEXT = PAGE.read_text(encoding="utf-8")
PRINTED = re.findall(r"^```text\n(.*?)^```$", TEXT, flags=re.DOTALL | re.MULTILINE)[0]


def test_explains_eight_lines():
    assert len(PRINTED.splitlines()) == 8
    about = TEXT.partition(PRINTED)[2].partition("Write the report again")[0]
    lines = ["Line 1", "Lines 2 to 4", "Line 5", "Line 6", "Line 7", "Line 8"]
    assert re.findall(r"^- \*\*(.*?)\*\*: ", about, flags=re.MULTILINE) == lines


@pytest.mark.slow
def test_shows_what_is_printed(command_line, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    command = re.findall(r"^```sh\nmerge-sumo (.*)$", TEXT, flags=re.MULTILINE)[0]
    code, out, _ = command_line(*shlex.split(command), "-q")
    assert (code, out) == (0, PRINTED)
