"""The kinds of VUT by name: the part of a spec before the colon, for most of them."""

from __future__ import annotations

from typing import Final

from merge_sumo.system.registry import Registry
from merge_sumo.vuts.base import BUILT_IN, HERE, INSTALLED, PYTHON, ControllerKind

KINDS: Final[Registry[type[ControllerKind]]] = Registry(
    "merge_sumo.vut_kinds",
    "kind of VUT",
    {
        PYTHON: "merge_sumo.vuts.python:PythonKind",
        "traci": "merge_sumo.vuts.traci.vut:TraciKind",
        "sumo": "merge_sumo.vuts.sumo_model:SumoKind",
        "onnx": "merge_sumo.vuts.onnx:OnnxKind",
        "fmu": "merge_sumo.vuts.fmu:FmuKind",
        HERE: "merge_sumo.vuts.here:HereKind",
        INSTALLED: "merge_sumo.vuts.python:InstalledKind",
        BUILT_IN: "merge_sumo.vuts.built_in:BuiltInKind",
    },
    accepts=lambda item: isinstance(item, type) and issubclass(item, ControllerKind),
    contract="a subclass of merge_sumo.vuts.base.ControllerKind",
)
