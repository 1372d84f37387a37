"""The part of a spec behind "?": options as NAME=VALUE, joined by "&"."""

from __future__ import annotations

from merge_sumo.errors import UserError


def split_options(argument: str, spec: str) -> tuple[str, dict[str, str]]:
    """Return what stands before "?", and the options; `UserError` for what is no option."""
    before, _, text = argument.partition("?")
    options: dict[str, str] = {}
    for part in filter(None, text.split("&")):
        name, equals, value = part.partition("=")
        if not (name and equals and value):
            raise UserError(f"--vut {spec}: {part!r} is not an option: write NAME=VALUE")
        if name in options:
            raise UserError(f"--vut {spec}: the option {name} is there twice")
        options[name] = value
    return before, options
