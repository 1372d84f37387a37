"""Pages from templates: they escape values, and a policy allows only their style and script."""

from __future__ import annotations

import base64
import hashlib
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from markupsafe import Markup

from merge_sumo.files import GENERATOR, replace_own
from merge_sumo.printable import counted, printable, quoted, sentence
from merge_sumo.scenario.case import described
from merge_sumo.scenario.scenario import level_name

if TYPE_CHECKING:
    from jinja2 import Environment

X_AXIS = "x, m (0 at M, negative before it)"
"""Label of positions over time in all charts."""
TEMPLATES = Path(__file__).parent / "templates"
ERROR_CHARACTERS = 2000
"""Longest message or setting in a page; the files of the run folder have the whole text."""


def page(
    template: str, *, styles: tuple[str, ...] = (), scripts: tuple[str, ...] = (), **words: Any
) -> str:
    """Return a page as HTML that holds its style sheets and scripts.

    Args:
        template: name of the template.
        styles: names of style sheets to include.
        scripts: names of scripts to include.
        words: variables of the template.

    Example:
        >>> html = page("reproduce.html.jinja", result=result, table=table, pictures=[])
    """
    own = {}
    for name, files in (("style", styles), ("script", scripts)):
        source = "".join(map(source_of, files))
        digest = base64.b64encode(hashlib.sha256(source.encode()).digest()).decode()
        own[name] = Markup(source)  # noqa: S704 (our own files)
        own[f"{name}_hash"] = Markup(f"sha256-{digest}")  # noqa: S704 (by this a policy names it)
    return environment().get_template(template).render({**own, **words})


def replace_page(path: Path, html: str) -> None:
    """Write a page, in place of an older one.

    Args:
        path: file of the page.
        html: the page.

    Raises:
        UserError: it cannot be written, or merge-sumo did not create the file in its place.
    """
    replace_own(path, html.encode(errors="backslashreplace"), GENERATOR)


def source_of(name: str) -> str:
    """Return the text of a file of the templates' folder.

    Args:
        name: name of the file.
    """
    return (TEMPLATES / name).read_text(encoding="utf-8")


@cache
def environment() -> Environment:
    """Return the templates' environment, with the functions that every template has."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    made = Environment(
        loader=PackageLoader("merge_sumo.reports"),
        autoescape=True,
        trim_blocks=True,
        undefined=StrictUndefined,
    )
    made.globals |= {"level_name": level_name, "described": described, "x_axis": X_AXIS}
    made.globals |= {"counted": counted, "quoted": quoted, "sentence": sentence}
    made.filters["shown"] = _shown
    return made


def _shown(value: object) -> str:
    return printable(str(value)[:ERROR_CHARACTERS])
