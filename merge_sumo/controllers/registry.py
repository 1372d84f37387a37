"""The kinds of VUT by name: the part of a spec before the colon, for most of them."""

from __future__ import annotations

from typing import Final

from merge_sumo.controllers.base import BUILT_IN, HERE, INSTALLED, PYTHON, ControllerKind
from merge_sumo.registry import Registry

KINDS: Final[Registry[type[ControllerKind]]] = Registry(
    "merge_sumo.vut_kinds",
    "kind of VUT",
    {
        PYTHON: "merge_sumo.controllers.python:PythonKind",
        "traci": "merge_sumo.controllers.traci.vut:TraciKind",
        "sumo": "merge_sumo.controllers.sumo_model:SumoKind",
        "onnx": "merge_sumo.controllers.onnx:OnnxKind",
        "fmu": "merge_sumo.controllers.fmu:FmuKind",
        HERE: "merge_sumo.controllers.here:HereKind",
        INSTALLED: "merge_sumo.controllers.python:InstalledKind",
        BUILT_IN: "merge_sumo.controllers.built_in:BuiltInKind",
    },
    accepts=lambda item: isinstance(item, type) and issubclass(item, ControllerKind),
    contract="a subclass of merge_sumo.controllers.base.ControllerKind",
)
