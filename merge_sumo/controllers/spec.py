"""The way from a text, as after `--vut`, to a `VutSpec`, and what a spec alone says of its VUT."""

from __future__ import annotations

from merge_sumo.controllers.base import BUILT_IN, INSTALLED, PYTHON, WITHOUT_PREFIX, VutSpec
from merge_sumo.controllers.built_in import BUILT_IN_VUTS
from merge_sumo.controllers.here import object_of
from merge_sumo.controllers.registry import KINDS
from merge_sumo.errors import UserError


def parse(text: str) -> VutSpec:
    """Return the parts of `[KIND:]ARGUMENT[?NAME=VALUE&...]`; an unknown name is of `installed`.

    Raises `UserError` for what is no parameter, and for one that is given twice.
    """
    kind, _, argument = text.partition(":")
    if kind not in KINDS or kind in WITHOUT_PREFIX:
        kind, argument = "", text
    elif not KINDS[kind].has_parameters:
        return VutSpec(kind, argument)
    argument, _, options = argument.partition("?")
    parameters: dict[str, str] = {}
    for part in filter(None, options.split("&")):
        name, _, value = part.partition("=")
        if not (name and value):
            raise UserError(f"{text}: {part!r} is not an option: write NAME=VALUE")
        if name in parameters:
            raise UserError(f"{text}: the option {name} is there twice")
        parameters[name] = value
    if not kind:
        named = PYTHON if ":" in argument else INSTALLED
        kind = BUILT_IN if argument in BUILT_IN_VUTS else named
    return VutSpec(kind, argument, tuple(parameters.items()))


def is_built_in(text: str) -> bool:
    """Return whether a spec names a VUT that the package brings, with parameters or without."""
    return parse(text).kind == BUILT_IN


def runs_code(text: str) -> bool:
    """Return whether to test a VUT is to run code that is not of this package or of SUMO."""
    spec = parse(text)
    kind = KINDS[spec.kind]
    return kind.own_code and not kind.waits(spec.argument)


def names_code(text: str) -> bool:
    """Return whether who writes a spec says which code of a user's is run.

    An object of this process was put there by who runs it.
    """
    return runs_code(text) and object_of(parse(text)) is None


def waits_for_client(text: str) -> bool:
    """Return whether a person starts the VUT's program, which then cannot be begun anew."""
    spec = parse(text)
    return KINDS[spec.kind].waits(spec.argument)
