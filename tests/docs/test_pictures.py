"""Pictures of README and of the site are made by one command, and show what the tool shows."""

from __future__ import annotations

import re
import subprocess
import sys

import make_pictures
import pytest
from conftest import require
from docs_pages import ROOT
from PIL import Image

PAGES = [ROOT / "README.md", *ROOT.glob("docs/**/*.md")]
PICTURE = re.compile(r"\]\(([^):]+\.(?:png|svg))\)")
MOST_BYTES = 200_000
CLIPPED = """() => {
  const inside = (text, box) => text.left >= box.left && text.right <= box.right
    && text.top >= box.top && text.bottom <= box.bottom;
  const clipped = [];
  for (const text of document.querySelectorAll("text")) {
    const own = text.getBoundingClientRect();
    const x = own.left + own.width / 2, y = own.top + own.height / 2;
    for (const rect of document.querySelectorAll("rect")) {
      const box = rect.getBoundingClientRect();
      const around = box.left < x && x < box.right && box.top < y && y < box.bottom;
      if (around && !inside(own, box)) clipped.push(text.textContent);
    }
  }
  return clipped;
}"""
"""Texts that are in the middle of a box, and leave it."""


def test_the_command_makes_each_picture_of_a_page_and_no_other():
    shown = set()
    for page in PAGES:
        for link in PICTURE.findall(page.read_text(encoding="utf-8")):
            shown.add((page.parent / link).resolve().relative_to(ROOT).as_posix())
    made = {name for name in make_pictures.MAKERS if (ROOT / name).is_file()}
    stored = [*ROOT.glob("scenarios/**/*.png"), *ROOT.glob("docs/**/*.svg")]
    assert made == shown == {path.relative_to(ROOT).as_posix() for path in stored}
    for name in shown:
        assert (ROOT / name).stat().st_size < MOST_BYTES


def test_a_picture_with_another_text_is_named_and_made_again(tmp_path, monkeypatch, capsys):
    def draw(new):
        if new:
            Image.new("RGB", (4, 4), "#d55e00").save(new)
        return "44 failures\n"

    monkeypatch.setattr(make_pictures, "ROOT", tmp_path)
    monkeypatch.setattr(make_pictures, "MAKERS", {"a.png": draw})

    def main(*arguments):
        monkeypatch.setattr(sys, "argv", ["make_pictures.py", *arguments])
        with pytest.raises(SystemExit) as end:
            make_pictures.main()
        return end.value.code, capsys.readouterr().out

    code, said = main("--check")
    assert code == 1
    assert said.startswith("a.png is not of today's tool:\n")
    assert said.endswith("+44 failures\n")
    assert not (tmp_path / "a.png").exists()
    assert main()[0] == 0
    assert main("--check") == (0, "")
    with Image.open(tmp_path / "a.png") as image:
        assert image.convert("RGB").getpixel((0, 0)) == (0xD5, 0x5E, 0)
        assert image.info["Description"] == "44 failures\n"


@pytest.mark.parametrize("name", ["scenario", "architecture"])
def test_no_text_of_a_drawing_is_clipped(name):
    require(make_pictures.CHROMIUM is not None, "chromium is not on the PATH")
    with make_pictures.browser_page() as page:
        page.goto((ROOT / "docs" / "pictures" / f"{name}.svg").as_uri())
        assert page.locator("text").count() > 15
        assert page.evaluate(CLIPPED) == []


@pytest.mark.slow
def test_the_texts_of_all_pictures_are_those_of_the_tool():
    require(make_pictures.CHROMIUM is not None, "chromium is not on the PATH")
    command = [sys.executable, "tools/make_pictures.py", "--check"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (0, ""), "run `python tools/make_pictures.py`"
