"""The kinds of VUT by name: the part of a spec before the colon, for most of them."""

from __future__ import annotations

from typing import Final

from merge_sumo.system.registry import Registry
from merge_sumo.vuts.base import BUILT_IN, HERE, INSTALLED, PYTHON, VutKind

KINDS: Final[Registry[VutKind]] = Registry(
    "merge_sumo.vut_kinds",
    "kind of VUT",
    {
        PYTHON: "merge_sumo.vuts.python:KIND",
        "traci": "merge_sumo.vuts.traci.vut:KIND",
        "sumo": "merge_sumo.vuts.sumo_model:KIND",
        "onnx": "merge_sumo.vuts.onnx:KIND",
        "fmu": "merge_sumo.vuts.fmu:KIND",
        HERE: "merge_sumo.vuts.here:KIND",
        INSTALLED: "merge_sumo.vuts.python:INSTALLED_KIND",
        BUILT_IN: "merge_sumo.vuts.built_in:KIND",
    },
    accepts=lambda item: isinstance(item, VutKind),
    contract="a merge_sumo.vuts.base.VutKind",
)
