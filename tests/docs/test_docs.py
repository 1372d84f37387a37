"""The pages lead somewhere, also where somebody reads them in a checkout: CI builds the site."""

from __future__ import annotations

import re
from pathlib import Path
from types import SimpleNamespace

import pytest
from docs_pages import GENERATED, ROOT, SHOWN, on_page_markdown

LINK = re.compile(r"\]\(([^)#\s]+)(?:#[^)]*)?\)")
PAGES = [*ROOT.glob("docs/**/*.md"), ROOT / "README.md", *(ROOT / page for page in SHOWN)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_links_lead_to_what_is_there_or_is_made_from_the_code(page: Path):
    made = {ROOT / "docs" / name for name in GENERATED}
    for link in LINK.findall(page.read_text(encoding="utf-8")):
        if "://" not in link:
            target = (page.parent / link).resolve()
            assert target.exists() or target in made, link


def test_the_site_has_what_lies_outside_of_docs_one_folder_nearer():
    deep = SimpleNamespace(file=SimpleNamespace(src_uri="explanations/paper.md"))
    text = on_page_markdown("[a](../../policies/README.md) [b](../faq.md)", deep)
    assert text == "[a](../policies/README.md) [b](../faq.md)"
    start = SimpleNamespace(file=SimpleNamespace(src_uri="index.md"))
    assert on_page_markdown("[a](../README.md)", start) == "[a](README.md)"
    shown = SimpleNamespace(file=SimpleNamespace(src_uri="policies/README.md"))
    assert on_page_markdown("[a](../docs/faq.md)", shown) == "[a](../faq.md)"
    root = SimpleNamespace(file=SimpleNamespace(src_uri="SECURITY.md"))
    assert on_page_markdown("[a](docs/faq.md)", root) == "[a](faq.md)"
