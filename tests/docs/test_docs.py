"""The pages lead somewhere, also where somebody reads them in a checkout: CI builds the site."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from docs_pages import DOCS, ROOT, SHOWN, TABLE, TABLES, WRITTEN, on_page_markdown

from merge_sumo.controllers.kinds import KINDS
from merge_sumo.samplers.registry import SAMPLERS

LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
NAMED_FILE = re.compile(r"(?<![\w/])((?:merge_sumo|tests|tools)/[\w/-]+\.py)\b")
PAGES = [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", *(ROOT / page for page in SHOWN)]


def defined_in(file: Path) -> set[str]:
    """Return the names of the functions and classes of a file."""
    tree = ast.parse(file.read_text(encoding="utf-8"))
    kinds = ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef
    return {node.name for node in ast.walk(tree) if isinstance(node, kinds)}


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

    def test_names_files_that_are_there(self):
        named = set(re.findall(r"`([\w/]+(?:\.py|/))`", self.PAGE))
        assert len(named) > 30
        below = (ROOT, ROOT / "merge_sumo")
        assert [name for name in named if not any((one / name).exists() for one in below)] == []

    def test_names_functions_and_classes_that_are_there(self):
        names = {name for file in (ROOT / "merge_sumo").rglob("*.py") for name in defined_in(file)}
        named = set(re.findall(r"`(?:\w+\.)?(?!py`)([A-Za-z_]\w+)(?:\([\w, ]*\))?`", self.PAGE))
        assert len(named) > 15
        assert named - names == set()

    def test_names_functions_in_the_files_that_have_them(self):
        where = re.compile(r"`(\w+)(?:\([\w, ]*\))?`(?:, then `(\w+)`,)? (?:in |\()`([\w/]+\.py)`")
        named = where.findall(self.PAGE)
        assert len(named) >= 6
        for *functions, file in named:
            assert {*functions} - {""} <= defined_in(ROOT / "merge_sumo" / file), (functions, file)


# The list of changes names what earlier versions had.
@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.name != "CHANGELOG.md"],
    ids=lambda page: page.relative_to(ROOT).as_posix(),
)
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
