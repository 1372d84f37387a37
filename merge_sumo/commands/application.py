"""The application: commands whose options stand in groups and are given once."""

from __future__ import annotations

import inspect
import re
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer
from typer.core import TyperCommand, TyperGroup, TyperOption

from merge_sumo.commands.printing import notices_printed, print_result, say
from merge_sumo.errors import UserError
from merge_sumo.help_texts import with_names
from merge_sumo.options import (
    GROUPS,
    WHERE,
    Asked,
    Execution,
    Option,
    flags_of,
    options_of,
)

if TYPE_CHECKING:
    from merge_sumo.system.result import Result


PANELS: Final[Mapping[str, tuple[str, ...]]] = {
    "Search": ("campaign", "run", "probability"),
    "Look": ("report", "explain", "replay", "export"),
    "Change": ("rerun", "compare", "repair"),
    "Bring your own": ("vuts", "check-vut", "scenario", "train"),
    "Research": ("truth", "benchmark", "reproduce"),
}
"""Commands by panel of the help, the most used first."""
PANEL_OF: Final = {name: panel for panel, names in PANELS.items() for name in names}
GONE: Final[Mapping[str, str]] = {
    "board": "`merge-sumo report` prints on A4, and `report --json` has each fact with its source",
    "crosscheck": "`python tools/crosscheck.py RUN`, in a checkout, repeats cases in HighwayEnv",
    "policies": "`python tools/export_policy.py NAME FILE`, in a checkout, writes an ONNX network",
    "compare-runs": "`merge-sumo compare RUN RUN...` compares what is recorded",
    "history": "`merge-sumo compare RUN RUN...` compares any number of recorded versions",
    "stress": "`merge-sumo rerun RUN --stress` does it",
    "certify": "after a campaign without failures, `merge-sumo probability RUN --cases 100000` "
    "bounds how much of the pool can fail",
}
"""What replaces a command of an earlier version, by its name."""


def unwrapped(text: str) -> str:
    """Return a docstring with each paragraph in one line, so that only the terminal wraps it."""
    paragraphs = re.split(r"\n\s*\n", inspect.cleandoc(text))
    return "\n\n".join(" ".join(paragraph.split("\n")) for paragraph in paragraphs)


class GroupedCommand(TyperCommand):
    """A command whose options stand in `GROUPS`; it prints the notices of the API."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        order = {group: place for place, group in enumerate(GROUPS)}
        # Arguments stay in front, in their order.
        self.params.sort(key=lambda p: order.get(getattr(p, "rich_help_panel", None) or "", -1))

    def get_params(self, ctx: Any) -> list[Any]:
        """Return the options; `{samplers}` in a help text becomes the names of a registry."""
        for parameter in self.params:
            if isinstance(parameter, TyperOption):
                parameter.help = with_names(parameter.help or "")
        return super().get_params(ctx)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Parse the arguments; `UserError` where an option would win over itself."""
        # Parsing empties the list.
        _, _, given = self.make_parser(ctx).parse_args(args=list(args))
        for option, times in Counter(given).items():
            single = not (getattr(option, "multiple", False) or getattr(option, "count", False))
            chooses = not getattr(option, "is_flag", False) or bool(option.secondary_opts)
            if option.param_type_name == "option" and single and chooses and times > 1:
                name = max(option.opts, key=len)
                raise UserError(f"{name} is given {times} times: give it once")
        return super().parse_args(ctx, args)

    def invoke(self, ctx: Any) -> Any:
        """Run the command; a `Notice` becomes a sentence on standard error, and so does Ctrl-C."""
        with notices_printed():
            try:
                return super().invoke(ctx)
            except KeyboardInterrupt:
                say("stopped")
                raise
            except (EOFError, BrokenPipeError) as error:
                # Of a channel of ours: typer would take it for that of a terminal, and end with 1.
                raise RuntimeError("a channel was closed") from error


class CommandGroup(TyperGroup):
    """A group that shows its commands by `PANELS`, and names the successor of one that is gone."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the commands in the order of `PANELS`."""
        order = list(PANEL_OF)
        names = super().list_commands(ctx)
        return sorted(names, key=lambda name: order.index(name) if name in order else len(order))

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Return the command that the first argument names; `UserError` where it is gone."""
        if args and args[0] in GONE:
            raise UserError(f"the command {args[0]} is gone: {GONE[args[0]]}")
        return super().resolve_command(ctx, args)


@dataclass(frozen=True, slots=True)
class Given:
    """The options of a command that it passes on, as keywords of the API.

    Attributes:
        keywords: all of them, written or by default.
        written: those that a person wrote, and `workers` and `progress`, which decide nothing.
        as_json: whether to print JSON.
    """

    keywords: dict[str, Any]
    written: dict[str, Any]
    as_json: bool

    def print(self, result: Result, **more: object) -> None:
        """Print a result, and paths that belong to it: see `print_result`."""
        print_result(result, as_json=self.as_json, **more)


JSON: Final = Annotated[
    bool,
    typer.Option(
        "--json",
        help="Print the result as one JSON object on standard output.",
        rich_help_panel=WHERE,
    ),
]
IN_ANY_CASE: Final = frozenset(one.name for one in fields(Execution))
"""Keywords that decide nothing, which are passed on whether or not they were written."""


class Commands(typer.Typer):
    """An application of `GroupedCommand`s, with the options of records and --json."""

    def __init__(self, *, help: str, **options: Any) -> None:
        super().__init__(cls=CommandGroup, help=unwrapped(help), **options)

    def verb(
        self, record: type[Asked] | None = None, name: str | None = None
    ) -> Callable[[Callable[..., None]], Callable[..., None]]:
        """Register a function as a command; its docstring, or that of the record, is the help.

        Its first parameter is `Given`, which has the options of the record. The other parameters
        are arguments and options that the function reads.
        """
        passed = {} if record is None else options_of(record)

        def register(function: Callable[..., None]) -> Callable[..., None]:
            _, *read = inspect.signature(function, eval_str=True).parameters.values()

            def command(context: typer.Context, as_json: bool, **values: Any) -> None:
                given = {
                    keyword: values.pop(keyword) or default
                    if default == ()
                    else values.pop(keyword)
                    for keyword, (_, default) in passed.items()
                }
                written = {
                    keyword: value
                    for keyword, value in given.items()
                    if keyword in IN_ANY_CASE or _is_written(context, keyword)
                }
                function(Given(given, written, as_json), **values)

            parameters = [
                _parameter("context", typer.Context),
                *(parameter.replace(kind=inspect.Parameter.KEYWORD_ONLY) for parameter in read),
                *(_of_option(keyword, *known) for keyword, known in passed.items()),
                _parameter("as_json", JSON, default=False),
            ]
            command.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
            command.__name__, command.__annotations__ = function.__name__, {}
            panel = PANEL_OF.get(name or function.__name__)
            text = unwrapped(function.__doc__ or (record and record.__doc__) or "")
            self.command(name, cls=GroupedCommand, help=text, rich_help_panel=panel)(command)
            return function

        return register


def _is_written(context: typer.Context, keyword: str) -> bool:
    source = context.get_parameter_source(keyword)
    return source is not None and source.name == "COMMANDLINE"


def _of_option(keyword: str, known: Option, default: Any) -> inspect.Parameter:
    """Return a parameter of a command for a field of a record."""
    shown = typer.Option(
        *flags_of(keyword, known),
        help=known.help,
        metavar=known.metavar,
        show_default=known.shown or True,
        callback=known.parse,
        rich_help_panel=known.group,
    )
    default = None if default == () else default
    kind = known.kind if default is not None else known.kind | None
    return _parameter(keyword, Annotated[kind, shown], default)


def _parameter(
    name: str, annotation: Any, default: object = inspect.Parameter.empty
) -> inspect.Parameter:
    return inspect.Parameter(
        name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation
    )


app = Commands(
    help="""Find where a merging controller fails against drivers who react to it.

    A vehicle under test (VUT) merges from an on-ramp of US-23 in SUMO while a primary other
    vehicle (POV) on the mainline interacts with it. A sampler chooses the test cases; a case fails
    where both reach the merge point within 6 m, or by a rule of your own, and failure mode
    coverage (FMC) says how much of the failing region was found.

    Start with:  merge-sumo campaign --vut design2
    """,
    no_args_is_help=True,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)
