"""Pictures of README and of the site are made by one command, and show what the tool shows."""

from __future__ import annotations

import subprocess
import sys

import make_pictures
import pytest
from conftest import require
from make_pictures import CHROMIUM, MAKERS, ROOT
from PIL import Image

NEEDS_CHROMIUM = "chromium is not on the PATH"


def test_the_command_makes_each_picture_of_a_page_and_no_other():
    made = {name for name in MAKERS if name.endswith((".png", ".svg"))}
    assert made == make_pictures.pictures_on_pages()
    sizes = [(ROOT / name).stat().st_size for name in made]
    assert 2_000 < min(sizes) < max(sizes) < 200_000


def test_a_picture_with_another_text_is_told_and_made_again(tmp_path, monkeypatch):
    def draw(new):
        if new:
            Image.new("RGB", (4, 4), "#d55e00").save(new)
        return "44 failures"

    monkeypatch.setattr(make_pictures, "ROOT", tmp_path)
    monkeypatch.setitem(MAKERS, "a.png", draw)
    assert make_pictures.difference("a.png")[-1] == "+44 failures"
    make_pictures.make("a.png")
    assert make_pictures.difference("a.png") == []
    with Image.open(tmp_path / "a.png") as image:
        assert image.convert("RGB").getcolors() == [(16, (0xD5, 0x5E, 0x00))]


@pytest.mark.parametrize("name", [name for name in MAKERS if name.endswith(".svg")])
def test_no_text_of_a_drawing_is_clipped(name):
    require(CHROMIUM is not None, NEEDS_CHROMIUM)
    assert make_pictures.clipped_texts(name) == []


@pytest.mark.slow
def test_the_texts_of_all_pictures_are_those_of_the_tool():
    require(CHROMIUM is not None, NEEDS_CHROMIUM)
    command = [sys.executable, make_pictures.__file__, "--check"]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), "run `python tools/make_pictures.py`"
