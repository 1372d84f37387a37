"""The shipped policies: safetensors with a manifest that says what they are."""

from __future__ import annotations

import hashlib
import json
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.drivers.levelk import ACTIONS, FEATURES, SVO_FEATURES, LevelKDriver, QNetwork
from merge_sumo.errors import UserError
from merge_sumo.system.resources import resource
from merge_sumo.values.scenario import US23, Scenario

MANIFEST: Final = "manifest.json"
NETWORKS: Final = ("pov1", "vut1", "pov2", "vut2")
"""In the order of the helix: each is trained against an earlier one, or against level 0."""
PLAYED: Final = (
    *("x_pov0_m", "v_pov0_mps", "x_vut0_m", "v_vut0_mps", "a_min_mps2", "a_max_mps2"),
    *("v_hw_min_mps", "v_hw_max_mps", "v_min_mps", "ttc_min_s", "dx_crash_m", "dx_critical_m"),
    *("level0_a_mps2", "level0_v_mps", "timeout_s"),
)
"""Numbers of a scenario that decide what a driver learns; the road and other cars do not."""


def read_manifest(folder: Path | None = None) -> dict[str, dict[str, Any]]:
    """Return what is known of each network, by name; empty where nothing was trained yet."""
    path = (folder or resource("policies")) / MANIFEST
    if not path.is_file():
        return {}
    try:
        networks = json.loads(path.read_text(encoding="utf-8"))["networks"]
        found = {name: dict(networks[name]) for name in NETWORKS if name in networks}
        for name, entry in found.items():
            if not isinstance(entry["sha256"], str):
                raise TypeError(f"the sha256 of {name} is no text")
            scenario_of(entry)
        return found
    except (OSError, ValueError, KeyError, TypeError, RecursionError, UserError) as error:
        raise UserError(f"{path} is not a readable manifest of policies: {error}") from error


def scenario_record(scenario: Scenario) -> dict[str, Any]:
    """Return what a manifest says of the scenario that a network was trained for."""
    values = {name: getattr(scenario, name) for name in PLAYED}
    return {
        "name": scenario.name,
        **{k: list(v) if isinstance(v, tuple) else v for k, v in values.items()},
    }


def scenario_of(entry: dict[str, Any]) -> Scenario:
    """Return the scenario that a network was trained for, on no road; the paper's if none is said.

    Raises `UserError` when the manifest describes none.
    """
    record = entry.get("scenario", scenario_record(US23))
    if not isinstance(record, dict) or not set(record) <= {"name", *PLAYED}:
        raise UserError("the scenario of a policy is a table of its numbers")
    return Scenario.from_record(record)


def plays_as(one: Scenario, other: Scenario) -> bool:
    """Return whether a driver learns the same in two scenarios."""
    return all(getattr(one, name) == getattr(other, name) for name in PLAYED)


def load_network(name: str, folder: Path | None = None) -> QNetwork:
    """Return a network; `UserError` when it is missing or is not the file of its manifest."""
    folder = folder or resource("policies")
    entry = read_manifest(folder).get(name)
    if entry is None:
        raise UserError(f"there is no policy {name!r}: run `merge-sumo train` to make it")
    path = folder / f"{name}.safetensors"
    try:
        content = path.read_bytes()
    except OSError as error:
        raise UserError(f"cannot read the policy {path}: {error.strerror}") from error
    return _parse(content, str(path), str(entry.get("sha256")), name)


@cache
def _parse(content: bytes, path: str, sha256: str, name: str) -> QNetwork:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    if hashlib.sha256(content).hexdigest() != sha256:
        raise UserError(
            f"{path} is not the file that its manifest describes: get it again, or run "
            f"`merge-sumo train --only {name}`"
        )
    try:
        network = QNetwork.from_tensors(load(content))
        inputs, outputs = network.layers[0][0].shape[1], network.layers[-1][0].shape[0]
        network.values(np.zeros((1, inputs)))
    except (SafetensorError, KeyError, ValueError, TypeError, IndexError, OverflowError) as error:
        raise UserError(f"{path} holds no action-value network: {error}") from error
    expected = FEATURES + (SVO_FEATURES if name == "pov2" else 0)
    if (inputs, outputs) != (expected, ACTIONS):
        raise UserError(f"{path} has {inputs} inputs and {outputs} actions: train it again")
    return network


def load_driver(name: str, corridors: int, folder: Path | None = None) -> LevelKDriver:
    """Return the driver that acts by a network."""
    return LevelKDriver(corridors, load_network(name, folder))
