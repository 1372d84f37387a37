"""The kinds of controllers by name; from a text, as after `--vut`, to a loaded controller."""

from __future__ import annotations

from merge_sumo.controllers.built_in import BUILT_IN_VUTS
from merge_sumo.controllers.hosted import SUPPORTED, HostedKind
from merge_sumo.controllers.python import installed_vuts
from merge_sumo.controllers.spec import (
    BUILT_IN,
    HERE,
    INSTALLED,
    PYTHON,
    WITHOUT_PREFIX,
    ControllerKind,
    ControllerOptions,
    ControllerSpec,
    load_as,
)
from merge_sumo.errors import UserError
from merge_sumo.printable import meant
from merge_sumo.registry import Registry

KINDS: Registry[type[ControllerKind]] = Registry(
    "merge_sumo.vut_kinds",
    "kind of VUT",
    {
        PYTHON: "merge_sumo.controllers.python:PythonKind",
        "traci": "merge_sumo.controllers.traci.vut:TraciKind",
        "sumo": "merge_sumo.controllers.sumo_model:SumoKind",
        "onnx": "merge_sumo.controllers.onnx:OnnxKind",
        "fmu": "merge_sumo.controllers.fmu:FmuKind",
        HERE: "merge_sumo.controllers.python:InProcessKind",
        INSTALLED: "merge_sumo.controllers.python:InstalledKind",
        BUILT_IN: "merge_sumo.controllers.built_in:BuiltInKind",
    },
    accepts=lambda item: isinstance(item, type) and issubclass(item, ControllerKind),
    contract="a subclass of merge_sumo.controllers.spec.ControllerKind",
)


def parse(text: str) -> ControllerSpec:
    """Return the parts of `[KIND:]ARGUMENT[?NAME=VALUE&...]`; of equal names the last counts.

    Args:
        text: a text as after `--vut`; an unknown name counts as that of an installed VUT.

    Raises:
        UserError: for a malformed parameter.
    """
    kind, _, argument = text.partition(":")
    if kind not in KINDS or kind in WITHOUT_PREFIX:
        kind, argument = "", text
    elif not KINDS[kind].has_parameters:
        return ControllerSpec(kind, argument)
    argument, _, options = argument.partition("?")
    parameters: dict[str, str] = {}
    for part in filter(None, options.split("&")):
        name, _, value = part.partition("=")
        if not (name and value):
            raise UserError(f"{text}: {part!r} is not an option: write NAME=VALUE")
        parameters[name] = value
    if not kind:
        named = PYTHON if ":" in argument else INSTALLED
        kind = BUILT_IN if argument in BUILT_IN_VUTS else named
    return ControllerSpec(kind, argument, tuple(parameters.items()))


def load(text: str, options: ControllerOptions | None = None) -> ControllerKind:
    """Load the controller that a text names, in a process of its own where its kind is hosted.

    Args:
        text: as after `--vut`.
        options: how it is hosted; None for the defaults.

    Raises:
        UserError: for a text that names no controller, or one that cannot be loaded.
    """
    spec, options = parse(text), options or ControllerOptions()
    if spec.kind == INSTALLED and spec.argument not in installed_vuts():
        raise UserError(_why_unknown(spec.argument))
    kind = KINDS[spec.kind]
    if kind.hosted and SUPPORTED and not options.in_process:
        return load_as(HostedKind, spec, options, None, kind)
    return load_as(kind, spec, options)


def _why_unknown(name: str) -> str:
    if name.endswith(".py"):
        return f"{name} is a file: name a class or a function in it, {name}:NAME"
    names = [*BUILT_IN_VUTS, *installed_vuts()]
    choice = f"{', '.join(names)}, or bring your own (`merge-sumo vuts` lists the kinds)"
    if not name:
        return f"no VUT is named: set `vut` to one of {choice}"
    return f"unknown VUT {name!r}: {meant(name, (*names, *KINDS))}choose one of {choice}"


def is_built_in(text: str) -> bool:
    """Return whether a VUT is one of this package, with parameters or without.

    Args:
        text: as after `--vut`.
    """
    return parse(text).kind == BUILT_IN


def waits_for_client(text: str) -> bool:
    """Return whether the user starts the VUT's program, so that it cannot be started again.

    Args:
        text: as after `--vut`.
    """
    spec = parse(text)
    return KINDS[spec.kind].waits(spec.argument)


def runs_code(text: str) -> bool:
    """Return whether a test of a VUT runs code that is neither of this package nor of SUMO.

    Args:
        text: as after `--vut`.
    """
    return KINDS[parse(text).kind].own_code and not waits_for_client(text)
