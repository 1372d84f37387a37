"""Pages name what exists, here and in a checkout, and one version; CI builds the site."""

from __future__ import annotations

import ast
import re
import tomllib
from importlib.metadata import version
from types import SimpleNamespace

import pytest
from docs_pages import DOCS, ROOT, SHOWN, TABLE, TABLES, WRITTEN, on_page_markdown

import merge_sumo as ms
from merge_sumo.controllers.kinds import KINDS
from merge_sumo.samplers.registry import SAMPLERS

LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
NAMED_FILE = re.compile(r"(?<![\w/])((?:merge_sumo|tests|tools)/[\w/-]+\.py)\b")
PAGES = [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", *(ROOT / page for page in SHOWN)]
PACKAGE = ROOT / "merge_sumo"


def text_of(name):
    """Return the text of a file of the checkout."""
    return (ROOT / name).read_text(encoding="utf-8")


def defined_in(file):
    """Return the names of the functions and classes of a file."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            names.add(node.name)
    return names


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_and_named_files_exist(page):
    text = page.read_text(encoding="utf-8")
    for link in LINK.findall(text):
        assert "://" in link or (page.parent / link).resolve().exists(), link
    if page.name != "CHANGELOG.md":  # which names what earlier versions had
        for name in NAMED_FILE.findall(text):
            assert (ROOT / name).exists(), name


@pytest.mark.parametrize("page", WRITTEN)
def test_pages_of_the_reference_are_those_of_the_code(page):
    written = (DOCS / page).read_text(encoding="utf-8")
    assert written == WRITTEN[page](), "run `python tools/docs_pages.py --write`"


class TestTheArchitecture:
    PAGE = text_of("docs/explanation/architecture.md")

    def test_lists_the_rooms_in_the_order_of_imports(self):
        rooms = re.findall(r"^\| `(\w+)/`", self.PAGE, re.MULTILINE)
        layers = text_of("tests/test_architecture.py")
        (listed,) = re.findall(r"^LAYERS = \((.*?)^\)$", layers, re.MULTILINE | re.DOTALL)
        assert rooms == re.findall(r'"(\w+)"', listed)

    def test_names_files_that_exist(self):
        for name in re.findall(r"`([\w/]+(?:\.py|/))`", self.PAGE):
            assert (ROOT / name).exists() or (PACKAGE / name).exists(), name

    def test_names_functions_and_classes_that_exist(self):
        names = set().union(*map(defined_in, PACKAGE.rglob("*.py")))
        named = re.findall(r"`(?:\w+\.)?(?!py`)([A-Za-z_]\w+)(?:\([\w, ]*\))?`", self.PAGE)
        assert set(named) <= names

    def test_names_functions_in_the_files_that_have_them(self):
        where = re.compile(r"`(\w+)(?:\([\w, ]*\))?`(?:, then `(\w+)`,)? (?:in |\()`([\w/]+\.py)`")
        for *functions, file in where.findall(self.PAGE):
            assert {*functions} - {""} <= defined_in(PACKAGE / file), (functions, file)


def test_tables_of_the_site_have_a_row_for_each_registered_object():
    shown = {name for page in PAGES for name in TABLE.findall(page.read_text(encoding="utf-8"))}
    assert shown == set(TABLES)
    page = SimpleNamespace(file=SimpleNamespace(src_uri="reference/vuts.md"))
    text = on_page_markdown("<!-- table: kinds of VUT -->\n\n<!-- table: samplers -->", page)
    forms = [kind.form for kind in KINDS.values() if kind.form]
    for name in (*SAMPLERS, *forms):
        assert f"| `{name}" in text


def test_version_and_day_of_the_release_are_the_same_everywhere():
    number = tomllib.loads(text_of("pyproject.toml"))["project"]["version"]
    assert ms.__version__ == version("merge-sumo") == number
    (day,) = re.findall(
        rf"^## {re.escape(number)} \((.*)\)$", text_of("CHANGELOG.md"), re.MULTILINE
    )
    citation = text_of("CITATION.cff")
    assert f"\nversion: {number}\n" in citation
    assert f"\ndate-released: {day}\n" in citation
    assert (PACKAGE / "py.typed").exists(), "the package is typed"
