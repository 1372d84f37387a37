"""Pages from templates: values are escaped, and a page names the style and script that it runs."""

from __future__ import annotations

import base64
import hashlib
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from markupsafe import Markup

from merge_sumo.values.scenario import level_name

if TYPE_CHECKING:
    from jinja2 import Environment

TEMPLATES: Final = Path(__file__).parent / "templates"


def page(
    template: str, *, styles: tuple[str, ...] = (), scripts: tuple[str, ...] = (), **words: Any
) -> str:
    """Return a page as HTML, with style sheets and scripts in it, by name, and words as needed."""
    style, source = ("".join(map(source_of, names)) for names in (styles, scripts))
    policy = {"style_hash": _policy_hash(style), "script_hash": _policy_hash(source)}
    own = {"style": Markup(style), "script": Markup(source)}  # noqa: S704 (our own files)
    return _environment().get_template(template).render({**own, **policy, **words})


def fragment(source: str, words: Mapping[str, Any]) -> Markup:
    """Return a part of a page, by the source of its template."""
    return Markup(_compiled(source).render(words))  # noqa: S704 (the template escapes values)


def source_of(name: str) -> str:
    """Return a file of the templates' folder."""
    return (TEMPLATES / name).read_text(encoding="utf-8")


@cache
def _environment() -> Environment:
    from jinja2 import Environment, PackageLoader

    loader = PackageLoader("merge_sumo.reports")
    environment = Environment(loader=loader, autoescape=True, trim_blocks=True)
    environment.globals["level_name"] = level_name
    return environment


@cache
def _compiled(source: str) -> Any:
    return _environment().from_string(source)


def _policy_hash(source: str) -> str:
    """Return by what a page's policy names a style or a script in it."""
    return "sha256-" + base64.b64encode(hashlib.sha256(source.encode()).digest()).decode()
