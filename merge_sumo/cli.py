"""The command line: each command parses a config, passes its fields to a function, and prints.

The functions are in `api.py`, where `api.verb` makes their config from the fields.
"""

from __future__ import annotations

import inspect
import os
import signal
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, TypeVar

from cyclopts import App, CycloptsError, Group, Parameter, Token

import merge_sumo as ms
from merge_sumo import config as c
from merge_sumo.console import (
    notices_printed,
    prepare_streams,
    print_json,
    print_result,
    say,
    show,
    stoppable,
)
from merge_sumo.errors import UserError
from merge_sumo.interrupt import Stopped, stopping_in_order
from merge_sumo.limits import check_limits, exhausted
from merge_sumo.printable import either, quoted
from merge_sumo.samplers.registry import SAMPLERS

if TYPE_CHECKING:
    from cyclopts import ArgumentCollection

    from merge_sumo import CaseRun

T = TypeVar("T")

SEARCH, LOOK, CHANGE, OWN, RESEARCH = map(
    Group.create_ordered,
    ("Find failures", "Inspect cases", "Compare versions", "Bring your own", "Research"),
)
OPTIONS = Group.create_ordered("Options")
MORE = Group.create_ordered("More options")
USED = """
run runs folder file index indices case vut net mainline ramp scenario level x_pov0_m v_pov0_mps
svo_rad recorded params only check samplers seeds cases seed fail_when against stress traffic
file_format gui quick figure workers out resume
"""
"""Fields that help shows first, in this order. All others are under "More options"."""
METAVARS: Mapping[str, str] = {
    "SPEC": "vut pov against",
    "CASES": "cases batch in_flight truth_cases",
    "SECONDS": "deadline_s follow_up_s from_s headway_ahead_s headway_behind_s",
    "GIB": "vut_memory_gib",
    "FOLDER": "policies resume",
    "FILE": "junit net distribution figure",
    "NAME|FILE": "scenario traffic",
    "LEVEL": "level",
    "CONDITION": "fail_when require",
    "NAME": "sampler engine file_format",
    "NAMES": "samplers",
    "N": "workers seed seeds repeat",
    "SHARE": "tolerated confidence",
    "GATE": "gates",
    "METRES": "x_pov0_m",
    "M/S": "v_pov0_mps",
    "RAD": "svo_rad",
    "RUN INDEX": "recorded",
    "NAME=NUMBER": "sense act at",
    "NAME=LOW..HIGH": "params",
    "EDGES": "mainline ramp",
    "M/S2": "a_min",
}
"""Fields of options, by the placeholder that help shows for their value."""
FIELDS: Mapping[str, Parameter] = {
    "progress": Parameter(negative=("--quiet", "-q")),
    "sampler": Parameter(help=f"Sampler: {either(SAMPLERS)}."),
    "workers": Parameter(show_default=False),
}
"""Other settings of an option, by the name of its field."""
GONE: Mapping[str, str] = {
    "board": "`merge-sumo report` prints on A4, and `report --json` lists each fact and its source",
    "crosscheck": "`python tools/crosscheck.py RUN`, in a checkout, repeats cases in HighwayEnv",
    "policies": "`python tools/export_policy.py NAME FILE`, in a checkout, writes an ONNX network",
    "compare-runs": "`merge-sumo compare RUN RUN...` compares recorded campaigns",
    "history": "`merge-sumo compare RUN RUN...` compares any number of recorded versions",
    "stress": "`merge-sumo rerun RUN --stress` replaces it",
    "repair": "`examples/repair.py`, in a checkout, searches with optuna and `merge_sumo.rerun`",
    "certify": "after a campaign without failures, `merge-sumo probability RUN --cases 100000` "
    "gives an upper bound on the share of the pool that fails",
}
"""Replacements of commands of earlier versions, by name."""
FAULT = 70
"""Exit code of a bug in this package: EX_SOFTWARE of sysexits.h."""

Options = Annotated[T, Parameter(name="*")]
Json = Annotated[bool, Parameter(help="Print the result as one JSON object.")]


class Commands(App):
    """An application whose commands take the fields of a dataclass as arguments and options."""

    def assemble_argument_collection(self, **how: Any) -> ArgumentCollection:
        """Return the arguments of a command, in groups.

        Args:
            **how: as of cyclopts.
        """
        arguments = super().assemble_argument_collection(**how)
        index = 0
        for argument in arguments:
            name = argument.field_info.name
            # Inherited keywords come first in a dataclass; cyclopts would not see the positional
            # arguments after them.
            if argument.keys and argument.field_info.is_positional:
                argument.index = index
                index += 1
            # Conditions may begin with a hyphen, and so may edges of nets of OpenDRIVE and OSM.
            more = Parameter(
                show_default=str(argument.field_info.default) not in ("None", "", "()", "False"),
                allow_leading_hyphen=bool(argument.keys) and argument.index is None,
                group=OPTIONS if name in USED.split() else MORE,
                # Further paragraphs of a docstring are for Python and the reference.
                help=(argument.parameter.help or "").partition("\n\n")[0],
            )
            for metavar, names in METAVARS.items():
                if name in names.split():
                    more = Parameter.combine(more, Parameter(metavar=metavar))
            argument.parameter = Parameter.combine(argument.parameter, more, FIELDS.get(name))
        arguments.sort(
            key=lambda each: (*USED.split(), each.field_info.name).index(each.field_info.name)
        )
        return arguments


def use_all_cores(_app: App, _commands: tuple[str, ...], arguments: ArgumentCollection) -> None:
    """Start a worker per core, unless the user sets a number.

    In Python the default is one, because each worker would run a script without a main guard again.

    Args:
        _app: the application.
        _commands: the words of the command.
        arguments: its arguments, which get the number of workers.
    """
    for argument in arguments:
        if argument.field_info.name == "workers" and not argument.has_tokens:
            argument.append(Token(keyword="--workers", value="auto"))


app = Commands(
    name="merge-sumo",
    help="""Find where a merging controller fails against drivers who react to it.

    A vehicle under test (VUT) merges from an on-ramp of US-23 in SUMO. A primary other vehicle
    (POV) on the mainline reacts to it. A sampler chooses the test cases. A case fails if both
    vehicles reach the merge point within 6 m of each other, or by your own rule. The failure mode
    coverage (FMC) shows how much of the failing region the search has found.

    Start with:  merge-sumo campaign --vut design2
    """,
    version=lambda: f"merge-sumo {version('merge-sumo')}",
    version_flags="--version",
    group_commands=MORE,
    default_parameter=Parameter(
        negative=(),
        name_transform=lambda name: c.flag_of(name).removeprefix("--"),
    ),
    config=use_all_cores,
    result_action="return_value",
    exit_on_error=False,
    print_error=False,
    suppress_keyboard_interrupt=False,
)
scenario = Commands(
    name="scenario",
    help="List, write and check scenarios: roads with a merge, and their numbers.",
    group=OWN,
)
app.command(scenario)
app.register_install_completion_command()


def command(
    kind: type[Any], group: Group | None = None, name: str | None = None, of: App = app
) -> Callable[[Callable[..., int]], Callable[..., int]]:
    """Return a decorator that registers a command, whose help is the docstring of its config.

    Args:
        kind: the config of the command.
        group: where the list of commands shows it.
        name: its name, by default that of the function.
        of: the application that has it.
    """
    return of.command(name=name, group=group, help=inspect.getdoc(kind))


@command(c.CampaignOptions, SEARCH)
def campaign(
    vut: Annotated[
        str,
        Parameter(
            help="Vehicle under test: a built-in one, such as design2, or your own controller. "
            "For all kinds, run: merge-sumo vuts.",
        ),
    ] = "",
    config: Options[c.CampaignOptions] = c.CampaignOptions(),
    *,
    resume: Annotated[
        Path | None,
        Parameter(help="Continue the campaign in this folder. A larger --cases adds cases."),
    ] = None,
    out: Annotated[
        Path | None,
        Parameter(metavar="FOLDER", help="New folder to write. [default: runs/VUT-DATE]"),
    ] = None,
    json: Json = False,
) -> int:
    """Run a campaign, or continue one, and print its result.

    Args:
        vut: the vehicle under test.
        config: the other options.
        resume: folder of the campaign that continues.
        out: new folder.
        json: whether the result is printed as JSON.

    Returns:
        The exit code.
    """
    if resume is not None and out is not None:
        raise UserError("--resume already sets the folder: omit --out")
    with stoppable() as check:
        if resume is None:
            run = ms.campaign(vut, **vars(config), out=out, check=check)
        else:
            run = ms.resume(resume, **vars(config), vut=vut or None, check=check)
    code = print_result(run, json)
    for remark in run.remarks():
        say(remark)
    return code


@command(c.CaseOptions, SEARCH)
def run(
    vut: Annotated[
        str | None,
        Parameter(
            help="VUT, as for merge-sumo campaign. With --case, only needed for your own code."
        ),
    ] = None,
    config: Options[c.CaseOptions] = c.CaseOptions(),
    *,
    at: Annotated[
        list[str] | None,
        Parameter(
            consume_multiple=True,
            help="Values of the start by name, such as x_pov0_m=-250 v_pov0_mps=30.",
        ),
    ] = None,
    json: Json = False,
) -> int:
    """Run a case and print its motion.

    Args:
        vut: the vehicle under test.
        config: the other options.
        at: coordinates of the case, as NAME=NUMBER.
        json: whether the result is printed as JSON.

    Returns:
        The exit code.
    """

    def ended(result: CaseRun) -> None:
        print_result(result, json, out=config.out if json else None)
        if config.out is not None and not json:
            show(f"saved: merge-sumo replay {quoted(config.out)} --gui")
        if config.gui and not json:
            say("the replay is open in sumo-gui: close the window to end")

    result = ms.run(vut, **vars(config), at=_coordinates(at or []), on_end=ended)
    return 0 if result.is_good else 1


def _coordinates(words: Sequence[str]) -> dict[str, float]:
    """Return coordinates that are written NAME=NUMBER."""
    values: dict[str, float] = {}
    for text in words:
        name, _, number = text.partition("=")
        try:
            values[name.strip()] = float(number)
        except ValueError:
            raise UserError(f"--at {text}: give NAME=NUMBER, such as x_pov0_m=-250") from None
    return values


@command(c.Probability, SEARCH)
def probability(config: Options[c.Probability], *, json: Json = False) -> int:
    file = config.out or Path(str(config.run)) / "probability.json"
    return print_result(ms.probability(**vars(config)), json, file=file)


@command(c.Report, LOOK)
def report(config: Options[c.Report], *, json: Json = False) -> int:
    run = ms.open_run(str(config.run))
    code = print_result(ms.report(run), json)
    if sentence := run.recorded.interruption:
        say(sentence)
    return code


@command(c.ReplayCase, LOOK)
def replay(
    config: Options[c.ReplayCase],
    *,
    gui: Annotated[bool, Parameter(help="Open the case in sumo-gui.")] = False,
    json: Json = False,
) -> int:
    """Replay a case in SUMO and print the comparison, or open it in sumo-gui.

    Args:
        config: the case and its folder.
        gui: whether sumo-gui opens it.
        json: whether the result is printed as JSON.

    Returns:
        The exit code.
    """
    if gui:
        ms.open_in_gui(**vars(config))
        return 0
    return print_result(ms.replay(**vars(config)), json)


@command(c.Export, LOOK)
def export(config: Options[c.Export], *, json: Json = False) -> int:
    paths = ms.export(**vars(config))
    if json:
        print_json({"written": list(map(str, paths))})
        return 0
    for path in paths:
        show(path)
    return 0


@command(c.Rerun, CHANGE)
def rerun(
    config: Options[c.Rerun],
    *,
    stress: Annotated[
        bool,
        Parameter(
            help="""Run each case with small changes of the simulation, and show which failures
            remain.

            A failure is robust if it fails with each change: a shorter step, an actuator with a
            lag, limited power, a start with the error of a sensor, and longer cars.""",
        ),
    ] = False,
    json: Json = False,
) -> int:
    """Run recorded cases again, with another VUT or a changed simulation, and print the changes.

    Args:
        config: the cases and the VUT.
        stress: whether the simulation changes, and not the VUT.
        json: whether the result is printed as JSON.

    Returns:
        The exit code.
    """
    if not stress:
        result = ms.rerun(**vars(config))
        page = {"page" if result.text is None else "cases": config.out}
        return print_result(result, json, **page)
    options = c.values_of(config, c.StudyOptions)
    if c.non_defaults(config, c.Rerun).keys() - options.keys() - {"run"}:
        raise UserError("--stress runs all cases: omit indices, --level, --out and --junit")
    return print_result(ms.stress(config.run, **options), json)


@command(c.Compare, CHANGE)
def compare(config: Options[c.Compare], *, json: Json = False) -> int:
    return print_result(ms.compare(**vars(config)), json, page=config.out)


def simple(
    kind: type[Any], verb: str, group: Group | None = None, name: str = "", of: App = app
) -> None:
    """Register a command that calls a verb and prints the result.

    Args:
        kind: the config of the command.
        verb: the name of the function of the API.
        group: where the list of commands shows it.
        name: its name, by default that of the verb.
        of: the application that has it.
    """

    def run_verb(config: Any, *, json: Json = False) -> int:
        return print_result(getattr(ms, verb)(**vars(config)), json)

    run_verb.__annotations__["config"] = Annotated[kind, Parameter(name="*")]
    if not any(one.default is MISSING for one in fields(kind)):
        run_verb.__defaults__ = (kind(),)
    command(kind, group, name or verb, of)(run_verb)


simple(c.Explain, "explain", LOOK)
simple(c.Vuts, "vuts", OWN)
simple(c.CheckVut, "check_vut", OWN, "check-vut")
simple(c.NewScenario, "new_scenario", OWN, "new", scenario)
simple(c.CheckScenario, "check_scenario", OWN, "check", scenario)
simple(c.Train, "train", OWN)
simple(c.GroundTruth, "truth", RESEARCH)
simple(c.Benchmark, "benchmark", RESEARCH)
simple(c.Reproduce, "reproduce", RESEARCH)


@command(c.Scenarios, OWN, "list", scenario)
def list_scenarios(*, json: Json = False) -> int:
    return print_result(ms.scenarios(), json)


def _check_working_folder() -> None:
    """Raise `UserError` if the working folder does not exist: relative paths would mean nothing."""
    try:
        Path.cwd()
    except OSError as error:
        raise UserError(
            f"cannot read the working folder ({error.strerror}): change to another one"
        ) from error


def execute(words: Sequence[str]) -> int:
    """Run a command and return its exit code.

    Args:
        words: the arguments of the command line.

    Raises:
        UserError: for bad use.
    """
    if words and words[0] in GONE:
        raise UserError(f"the command {words[0]} no longer exists: {GONE[words[0]]}")
    try:
        with notices_printed():
            return app(words) or 0
    except CycloptsError as error:
        raise UserError(str(error)) from error
    except SystemExit as ended:
        if isinstance(ended.__context__, BrokenPipeError):  # the reader of the help has gone
            raise Stopped(signal.SIGPIPE) from None
        raise


def main() -> None:
    """Run the command line and exit.

    A `UserError` becomes one sentence and exit code 2, and so does an error of the system that has
    run out of a resource. A command that a signal stops exits with 128 + the number of the signal.
    Any other error is a bug in this package and has its own exit code. Exit code 1, which Python
    would give, means that a gate is met.
    """
    prepare_streams()
    for library in ("OMP", "OPENBLAS", "MKL"):  # products are small, and the cores are for workers
        os.environ.setdefault(f"{library}_NUM_THREADS", "1")
    try:
        # From here on, so that no signal leaves a temporary folder behind.
        with stopping_in_order():
            _check_working_folder()
            check_limits()
            sys.exit(execute(sys.argv[1:]))
    except UserError as error:
        say(f"merge-sumo: {error}")
        sys.exit(2)
    except Stopped as stopped:
        sys.exit(stopped.exit_code)
    except KeyboardInterrupt:
        say("stopped")
        sys.exit(130)
    except Exception as error:
        if (sentence := exhausted(error)) is not None:
            say(f"merge-sumo: {sentence}")
            sys.exit(2)
        for line in traceback.format_exc().splitlines():
            say(line)
        say("merge-sumo: this is a bug in merge-sumo, not a result: report it with these lines")
        sys.exit(FAULT)


if __name__ == "__main__":
    main()
