"""The pages lead somewhere, also where somebody reads them in a checkout: CI builds the site."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from docs_pages import DOCS, ROOT, SHOWN, TABLE, TABLES, WRITTEN, on_page_markdown

from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.vuts.registry import KINDS

LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
NAMED_FILE = re.compile(r"(?<![\w/])((?:merge_sumo|tests|tools)/[\w/-]+\.py)\b")
PAGES = [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", *(ROOT / page for page in SHOWN)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_what_is_there_or_is_made_from_the_code(page: Path):
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" not in link:
            target = (page.parent / link).resolve()
            assert target.exists(), link


@pytest.mark.parametrize("page", WRITTEN)
def test_pages_of_the_reference_are_those_of_the_code(page: str):
    written = (DOCS / page).read_text(encoding="utf-8")
    assert written == WRITTEN[page](), "run `python tools/docs_pages.py --write`"


class TestTheArchitecture:
    PAGE = (ROOT / "docs/explanations/architecture.md").read_text(encoding="utf-8")

    def test_lists_the_rooms_in_the_order_of_imports(self):
        rooms = re.findall(r"^\| `(\w+)/`", self.PAGE, re.MULTILINE)
        layers = (ROOT / "tests/test_architecture.py").read_text(encoding="utf-8")
        (listed,) = re.findall(r"^LAYERS = \((.*?)^\)$", layers, re.MULTILINE | re.DOTALL)
        assert rooms == re.findall(r'"(\w+)"', listed)

    def test_names_at_most_eight_files_from_a_sampler_to_an_outcome(self):
        way = self.PAGE.partition("## The way of a case")[2].partition("\n## ")[0]
        files = set(re.findall(r"`(\w+/[\w/]+\.py)`", way))
        assert 1 < len(files) <= 8
        assert all((ROOT / "merge_sumo" / file).is_file() for file in files)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_files_that_a_page_names_exist(page: Path):
    names = NAMED_FILE.findall(page.read_text(encoding="utf-8"))
    assert [name for name in names if not (ROOT / name).exists()] == []


def test_tables_of_the_site_have_a_row_for_each_registered_object():
    shown = {name for page in PAGES for name in TABLE.findall(page.read_text(encoding="utf-8"))}
    assert shown == set(TABLES)
    page = SimpleNamespace(file=SimpleNamespace(src_uri="reference/vuts.md"))
    text = on_page_markdown("<!-- table: kinds of VUT -->\n\n<!-- table: samplers -->", page)
    assert "<!--" not in text
    kinds = [kind.form for kind in KINDS.values() if kind.form]
    assert all(f"| `{name}" in text for name in (*SAMPLERS, *kinds))
