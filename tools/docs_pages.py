"""Make the pages of the reference that come from the code, and prepare the pages of the site.

`python tools/docs_pages.py --write` writes those pages into docs/; a test compares them with the
code. MkDocs calls `on_files` and `on_page_markdown` (see `mkdocs.yml`).
"""

from __future__ import annotations

import inspect
import re
import sys
import textwrap
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

ROOT = Path(__file__).resolve().parent.parent
DOCS = ROOT / "docs"
SHOWN = (
    *("CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md", "tests/README.md"),
    *("policies/README.md", "policies/roundabout/README.md", "policies/human/README.md"),
    *("scenarios/README.md", "sumo_net/README.md"),
)
"""Pages of other folders than docs/, next to their subject."""
PICTURES = "scenarios/**/*.png"
NOTEBOOKS = "tutorials/*.ipynb"


COMMANDS: Final = """# Commands

This page lists all commands and all their options. `merge-sumo COMMAND --help` prints a
shorter text.

"""
EXIT_CODES: Final = """
## Exit codes

| exit code | meaning |
|---|---|
| 0 | The command finished. |
| 1 | The command finished, with a result that its section describes, such as a case that broke. |
| 2 | Wrong usage, or a limit of the system (disk, memory, processes), with one sentence. |
| 70 | A bug in merge-sumo, with a traceback. There is no result. |
| 130, 141, 143 | Stopped by Ctrl-C, by a closed pipe, by SIGTERM. |

## Shell completion

`merge-sumo --install-completion` lets your shell complete commands and options.
"""
COMMANDS_NEXT: Final = """
## Next step

[Python functions](python.md) lists the same commands for scripts and notebooks.
"""
CODE: Final = re.compile(r"`[^`]+`|(?<!\w)--[a-z][\w-]*|'[^']*[<(].*?'(?!\w)")
"""Code, an option or a condition in a text."""
DEFAULT: Final = re.compile(r"\s+\[default:\s+(.*?)\]", re.DOTALL)
"""The default of an option in its docstring."""


def cli_page() -> str:
    """Return the page of all commands, with the whole docstring of each option."""
    from merge_sumo.cli import app

    listed: dict[str, str] = {}
    sections = ""
    for words, command, panel in commands_of(app):
        title = f"merge-sumo {words}"
        about, *paragraphs = inspect.cleandoc(command.help).split("\n\n")
        line = f"- [`{words}`](#{title.replace(' ', '-')}): {about}\n"
        listed[panel] = listed.get(panel, "") + line
        examples = ""
        sections += f"\n## {title}\n\n{about}\n"
        for paragraph in paragraphs:
            if paragraph.startswith("Example:"):
                examples += paragraph.removeprefix("Example:").strip() + "\n"
            else:
                sections += f"\n{as_markdown(paragraph)}\n"
        with app.app_stack([app, command]):  # whose settings give the names of options
            sections += f"\n```text\n{examples}```\n{options_of(command)}"
    commands = "\n".join(f"**{panel}**\n\n{lines}" for panel, lines in listed.items())
    return f"{COMMANDS}{commands}{EXIT_CODES}{sections}{COMMANDS_NEXT}"


def as_markdown(text: str) -> str:
    """Return a text of help with code in backticks, and with each paragraph in one line.

    Args:
        text: paragraphs and lists.
    """
    text = re.sub(r"(?<!\n)\n(?![\n-])", " ", text)
    return CODE.sub(lambda code: f"`{code[0].strip('`')}`", text)


def commands_of(app: Any, front: str = "", panel: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yield the words of each command, the command, and the panel of help that lists it.

    Args:
        app: application of cyclopts.
        front: words before the name of each command.
        panel: the panel of all commands; by default each command has its own.
    """
    named = [each for each in app.resolved_commands().items() if not each[0].startswith("-")]
    if not panel:
        named.sort(key=lambda each: each[1].group[0].sort_key)
    for name, command in named:
        shown_in = panel or command.group[0].name
        if command.default_command is None:
            yield from commands_of(command, f"{front}{name} ", shown_in)
        else:
            yield front + name, command, shown_in


def options_of(command: Any) -> str:
    """Return the options of a command as lists, in the groups and the order of its help.

    Args:
        command: application of cyclopts.
    """
    from cyclopts import App
    from cyclopts.help import create_parameter_help_panel

    texts = {}
    # The arguments of merge-sumo have the first paragraph alone.
    for argument in App.assemble_argument_collection(command, parse_docstring=True):
        texts[argument.name] = as_markdown(inspect.cleandoc(argument.parameter.help or ""))
    groups: dict[str, str] = {}
    arguments = command.assemble_argument_collection(parse_docstring=True)
    shown = arguments.filter_by(show=True)
    for argument in sorted(shown, key=lambda each: each.index is None):  # positional ones first
        (group,) = argument.parameter.group
        panel = create_parameter_help_panel(group, type(arguments)([argument]), "plaintext")
        (entry,) = panel.entries
        about, *details = texts[argument.name].split("\n\n")
        about = DEFAULT.sub(r" Default: \1.", about)
        if entry.default:
            about += f" Default: {entry.default}."
        if entry.required:
            about += " Required."
        text = textwrap.indent("\n\n".join((about, *details)), "    ").strip()
        names = ", ".join(entry.display_labels_with_metavar)
        groups[group.name] = groups.get(group.name, "") + f"\n- `{names}`: {text}\n"
    return "".join(f"\n**{name}**\n{items}" for name, items in groups.items())


MEASURES_HEAD: Final = """# Measures

This page lists the measures of a case. They are in `outcomes.jsonl`, in the report, and in the \
conditions of `--fail-when`.

- VUT (vehicle under test): the vehicle that your controller drives.
- POV (primary other vehicle): the vehicle on the mainline (main road) that reacts to it.
- M (merge point): where both lanes become one. Positions x are 0 at M and negative before it.
- Follow-up: the simulated time after M, by default 3 s.
"""
MEASURES_TABLE: Final = """
The last column shows which values are worse. [A condition](verdicts.md#measures-without-a-value) \
uses a number in the place of None.

| name | unit | definition | worse |
|---|---|---|---|
"""
MEASURES_NEXT: Final = """
## Next step

- [Failure criteria](verdicts.md) shows how to write a condition over measures.
- [Add a measure](../../CONTRIBUTING.md) of your own.
"""


def measures_page() -> str:
    """Return the measures of an episode as a table."""
    from merge_sumo.metrics.measures import MEASURES, Measures

    rows = ""
    for name, measure in MEASURES.items():
        about = f"{measure.about}.".replace("|", r"\|")
        if measure.only_with:
            about += f" Only with {measure.only_with}."
        worse = f"{measure.worse}er" if measure.worse else ""
        rows += f"| `{name}` | {measure.unit} | {about} | {worse} |\n"
    # Further paragraphs of the docstring are about the code.
    _, about, *_ = inspect.cleandoc(Measures.__doc__ or "").split("\n\n")
    return f"{MEASURES_HEAD}\n{about}\n{MEASURES_TABLE}{rows}{MEASURES_NEXT}"


WRITTEN: dict[str, Callable[[], str]] = {
    "reference/cli.md": cli_page,
    "reference/measures.md": measures_page,
}
"""Pages below docs/ that are written from the code."""


def vut_kinds_table() -> str:
    """Return the registered kinds of VUT as a table."""
    from merge_sumo.controllers.kinds import KINDS

    kinds = [kind for kind in KINDS.values() if kind.form]
    rows = [f"| `{kind.form}` | {kind.what} | `{kind.example}` |" for kind in kinds]
    return "\n".join(("| form | kind | example |", "|---|---|---|", *rows))


def samplers_table() -> str:
    """Return the registered samplers as a table."""
    from merge_sumo.samplers.registry import SAMPLERS

    rows = [f"| `{name}` | {sampler.about} |" for name, sampler in SAMPLERS.items()]
    return "\n".join(("| `--sampler` | method |", "|---|---|", *rows))


def criteria_table() -> str:
    """Return the registered criteria as a table."""
    from merge_sumo.metrics.criterion import CRITERIA

    rows = [f"| `{name}` | `{one.condition}` | {one.about} |" for name, one in CRITERIA.items()]
    return "\n".join(("| `--fail-when` | condition | failure |", "|---|---|---|", *rows))


def formats_table() -> str:
    """Return the registered formats of export as a table."""
    from merge_sumo.reports.exports import FORMATS

    rows = [f"| `{name}` | {about} |" for name, about in FORMATS.items()]
    return "\n".join(("| `--format` | written |", "|---|---|", *rows))


def kinds_table() -> str:
    """Return the kinds of failures as a table."""
    from merge_sumo.metrics.timeline import KINDS

    rows = [f"| {name} | {rule} |" for name, rule in KINDS.items()]
    return "\n".join(("| kind | rule |", "|---|---|", *rows))


TABLES: dict[str, Callable[[], str]] = {
    "kinds of VUT": vut_kinds_table,
    "samplers": samplers_table,
    "criteria": criteria_table,
    "formats": formats_table,
    "kinds of failures": kinds_table,
}
"""Tables from registries. A page includes one with `<!-- table: NAME -->`."""
TABLE: Final = re.compile(r"<!-- table: ([\w ]+) -->")


def on_files(files: Any, config: Any) -> Any:
    """Add pages and pictures from other folders, and notebooks, to the site; MkDocs calls this.

    Args:
        files: files of the site.
        config: configuration of MkDocs.

    Returns:
        The files with those that were added.
    """
    from mkdocs.structure.files import File

    for path in (*SHOWN, *(p.relative_to(ROOT).as_posix() for p in ROOT.glob(PICTURES))):
        files.append(File.generated(config, path, abs_src_path=str(ROOT / path)))
    for notebook in DOCS.glob(NOTEBOOKS):
        for name, content in pages_of_notebook(notebook).items():
            files.append(File.generated(config, name, content=content))
    return files


def pages_of_notebook(path: Path) -> dict[str, str | bytes]:
    """Return an executed notebook as a page, and its pictures, by their paths on the site.

    Args:
        path: the notebook in docs/.
    """
    from nbconvert import MarkdownExporter

    exporter: Any = MarkdownExporter  # without types
    text, found = exporter().from_filename(str(path))
    place = path.relative_to(DOCS)
    made: dict[str, str | bytes] = {place.with_suffix(".md").as_posix(): text}
    for name, picture in found["outputs"].items():
        made[(place.parent / name).as_posix()] = picture
    return made


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return a page with its tables, and with links as the site has them; MkDocs calls this.

    Links into and out of docs/ are written as a checkout needs them.

    Args:
        markdown: the page as in the checkout.
        page: page of MkDocs.
    """
    markdown = TABLE.sub(lambda table: TABLES[table[1]](), markdown)
    markdown = markdown.replace(".ipynb)", ".md)")  # a notebook is a page of the site
    up = "../" * page.file.src_uri.count("/")
    if page.file.src_uri in SHOWN:
        return markdown.replace(f"]({up}docs/", f"]({up}")
    return markdown.replace(f"]({up}../", f"]({up}")


if __name__ == "__main__":
    if sys.argv[1:] != ["--write"]:
        sys.exit(f"say --write to write {', '.join(WRITTEN)} into docs/")
    for page, made in WRITTEN.items():
        (DOCS / page).write_text(made(), encoding="utf-8")
