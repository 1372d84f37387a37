"""Commands whose options stand in groups, and whose help is not wrapped twice."""

from __future__ import annotations

import inspect
import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Final, TextIO, TypeVar

import typer
from typer.core import TyperOption

from merge_sumo.commands.once import OnceCommand
from merge_sumo.errors import Notice
from merge_sumo.system.printable import printable
from merge_sumo.system.suggestions import either

GROUPS: Final[Mapping[str, tuple[str, ...]]] = {
    "What is tested": (
        *("vut", "vut_command", "level", "pov", "policies", "scenario", "net", "v_vut0"),
        *("mainline", "ramp", "follow_up", "case", "x", "v", "psi", "headway_ahead"),
        *("headway_behind", "only", "check"),
    ),
    "How many cases, and which": (
        *("sampler", "samplers", "cases", "batch", "seed", "seeds", "radius", "truth_cases"),
        *("dense", "quick", "distribution", "learn_from", "stop_after_converged"),
    ),
    "Verdict": ("fail_when", "require", "gate", "tolerance", "rerun", "confidence"),
    "Where it runs, and what it writes": (
        *("out", "resume", "force", "workers", "dask", "junit", "figure", "file_format"),
        *("gui", "debug", "quiet", "as_json"),
    ),
    "Trust and limits": ("trust_vut", "deadline", "vut_memory", "in_process"),
}
"""Options of the command line by group, in the order in which the groups are shown.

An option has one name and one group in all commands.
"""
GROUP_OF: Final = {name: group for group, names in GROUPS.items() for name in names}


def _samplers() -> Iterable[str]:
    from merge_sumo.samplers.registry import SAMPLERS

    return SAMPLERS


NAMES: Final[Mapping[str, Callable[[], Iterable[str]]]] = {"{samplers}": _samplers}
"""What stands for the names of a registry in a help text; they are looked up when it is shown."""

Function = TypeVar("Function", bound=Callable[..., Any])


def unwrapped(text: str) -> str:
    """Return a docstring with each paragraph in one line, so that only the terminal wraps it."""
    paragraphs = re.split(r"\n\s*\n", inspect.cleandoc(text))
    return "\n\n".join(" ".join(paragraph.split("\n")) for paragraph in paragraphs)


class GroupedCommand(OnceCommand):
    """A command whose options are grouped by `GROUPS`; it prints the notices of the API."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        """Set the group of each option, and sort the options by group."""
        super().__init__(*arguments, **options)
        order = {group: place for place, group in enumerate(GROUPS)}
        for parameter in self.params:
            if isinstance(parameter, TyperOption):
                parameter.rich_help_panel = GROUP_OF.get(parameter.name or "")
        # Arguments stay in front, in their order.
        self.params.sort(key=lambda p: order.get(getattr(p, "rich_help_panel", None) or "", -1))

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the options; `{samplers}` in a help text becomes the names of a registry."""
        for parameter in self.params:
            text = getattr(parameter, "help", None) or ""
            for placeholder, names in NAMES.items():
                if placeholder in text:
                    parameter.help = text = text.replace(placeholder, either(names()))  # type: ignore[attr-defined]
        return super().get_params(ctx)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; a `Notice` becomes a sentence on standard error, and so does Ctrl-C."""
        with notices_said():
            try:
                return super().invoke(ctx)
            except KeyboardInterrupt:
                typer.echo("stopped", err=True)
                raise


@contextmanager
def notices_said() -> Iterator[None]:
    """Print each `Notice` on standard error; other warnings are shown as ever."""
    with warnings.catch_warnings():
        warnings.simplefilter("always", Notice)
        show = warnings.showwarning

        def said(
            message: Warning | str,
            category: type[Warning],
            filename: str,
            lineno: int,
            file: TextIO | None = None,
            line: str | None = None,
        ) -> None:
            if issubclass(category, Notice):
                typer.echo(printable(str(message)), err=True)
            else:
                show(message, category, filename, lineno, file, line)

        warnings.showwarning = said
        yield


class Commands(typer.Typer):
    """An application whose commands are `GroupedCommand`s."""

    def __init__(self, *, help: str, **options: Any) -> None:
        """Take the help, each paragraph of which may stand in several lines."""
        super().__init__(help=unwrapped(help), **options)

    def command(self, name: str | None = None, **options: Any) -> Callable[[Function], Function]:
        """Register a function as a command; its docstring is the help."""

        def register(function: Function) -> Function:
            options.setdefault("cls", GroupedCommand)
            options.setdefault("help", unwrapped(function.__doc__ or ""))
            return super(Commands, self).command(name, **options)(function)

        return register
