"""Policies, shipped or of the user: safetensors files with a manifest that describes them."""

from __future__ import annotations

import hashlib
from functools import cache, partial
from pathlib import Path
from typing import Any

from merge_sumo.drivers.base import BuiltInVut
from merge_sumo.drivers.levelk import FEATURES, SVO_FEATURES, LevelKDriver, QNetwork
from merge_sumo.errors import UserError
from merge_sumo.files import read_limited, resource
from merge_sumo.printable import quoted
from merge_sumo.records import Record, convert, decode, to_plain
from merge_sumo.scenario.scenario import US23, Scenario

MANIFEST = "manifest.json"
NETWORKS = ("pov1", "vut1", "pov2", "vut2")
"""The networks in the order of the helix: each is trained against an earlier one or level 0."""
PLAYED = (
    *("x_pov0_m", "v_pov0_mps", "x_vut0_m", "v_vut0_mps", "a_min_mps2", "a_max_mps2"),
    *("v_hw_min_mps", "v_hw_max_mps", "v_min_mps", "ttc_min_s", "dx_crash_m", "dx_critical_m"),
    *("level0_a_mps2", "level0_v_mps", "timeout_s"),
)
"""Numbers of a scenario that decide the training of a driver; the road and other cars do not."""
MOST_BYTES = 1 << 26
"""Largest size of a network, and of a manifest."""


def policies_of(scenario: Scenario) -> Path:
    """Return the folder of the shipped policies of a scenario's name, else that of us23.

    Args:
        scenario: a scenario, shipped or of the user.
    """
    return _shipped().get(scenario.name, resource("policies"))


def _shipped() -> dict[str, Path]:
    """Return the shipped libraries by name, without that for us23."""
    libraries = {}
    for manifest in resource("policies").glob(f"*/{MANIFEST}"):
        libraries[manifest.parent.name] = manifest.parent
    return libraries


def policies_name(folder: Path) -> str:
    """Return the name of a shipped library, which any installation knows, else the whole path.

    Args:
        folder: folder of policies.
    """
    return folder.name if folder in _shipped().values() else str(folder)


def policies_in(folder: str | Path) -> Path:
    """Return the whole path of policies that a user or a record names.

    Args:
        folder: the name of a shipped library, else a folder.

    Raises:
        UserError: if there are none.
    """
    shipped = _shipped()
    if str(folder) in shipped:
        return shipped[str(folder)]
    path = Path(folder)
    try:
        if (path / MANIFEST).is_file():
            return path.resolve()
    except (OSError, ValueError):
        pass
    raise UserError(
        f"`policies`: {folder} has no readable manifest: choose a folder that `merge-sumo train "
        f"--out DIR` wrote, or a shipped library: {', '.join(sorted(shipped))}"
    )


def policies_sha256(folder: Path) -> dict[str, str]:
    """Return the hashes of the networks of a folder by name.

    Args:
        folder: folder of policies.

    Raises:
        UserError: if the manifest cannot be read.
    """
    return {name: entry["sha256"] for name, entry in read_manifest(folder).items()}


class _Manifest(Record, frozen=True):
    networks: dict[str, dict[str, Any]]


def read_manifest(folder: Path | None = None) -> dict[str, dict[str, Any]]:
    """Return the entries of a manifest by name of the network; none before a training.

    Args:
        folder: folder of policies; None for the shipped ones of us23.

    Raises:
        UserError: if the manifest cannot be read.
    """
    path = (folder or resource("policies")) / MANIFEST
    if not path.is_file():
        return {}
    try:
        networks = decode(read_limited(path, MOST_BYTES), _Manifest).networks
        known = {name: networks[name] for name in NETWORKS if name in networks}
        for entry in known.values():
            convert(entry.get("sha256"), str)
            scenario_of(entry)
        return known
    except (OSError, UserError) as error:
        raise UserError(f"{path} is not a readable manifest of policies: {error}") from error


def scenario_record(scenario: Scenario) -> dict[str, Any]:
    """Return the entry of a manifest for the scenario that a network was trained for.

    Args:
        scenario: the scenario.
    """
    record = to_plain(scenario)
    return {name: record[name] for name in ("name", *PLAYED, "reach_m", "v_start_max_mps")}


def scenario_of(entry: dict[str, Any]) -> Scenario:
    """Return the scenario that a network was trained for, without its road; us23 by default.

    Args:
        entry: entry of the network in a manifest.

    Raises:
        UserError: if the manifest has other entries for it.
    """
    return convert(entry.get("scenario", scenario_record(US23)), Scenario)


def plays_as(one: Scenario, other: Scenario) -> bool:
    """Return whether a driver learns the same in two scenarios.

    Args:
        one: a scenario.
        other: another one.
    """
    return all(getattr(one, name) == getattr(other, name) for name in PLAYED)


def load_network(name: str, folder: Path | None = None) -> QNetwork:
    """Load a network.

    Args:
        name: name of the network, such as "pov1".
        folder: folder of policies; None for the shipped ones of us23.

    Returns:
        The network; the same object for the same file.

    Raises:
        UserError: if it is missing, or is not the file of its manifest.
    """
    folder = folder or resource("policies")
    entry = read_manifest(folder).get(name)
    if entry is None:
        raise UserError(f"unknown policy {name!r}{how_to_train(folder)}")
    path = folder / f"{name}.safetensors"
    try:
        content = read_limited(path, MOST_BYTES)
    except OSError as error:
        raise UserError(f"cannot read the policy {path}: {error.strerror}") from error
    return _parse(content, str(path), str(entry.get("sha256")), name)


def how_to_train(folder: Path) -> str:
    """Return the end of a sentence on a missing network.

    Args:
        folder: folder of policies.
    """
    return f" in {folder}: run `merge-sumo train --out {quoted(folder)}` to make it"


@cache
def _parse(content: bytes, path: str, sha256: str, name: str) -> QNetwork:
    from safetensors import SafetensorError
    from safetensors.numpy import load

    if hashlib.sha256(content).hexdigest() != sha256:
        raise UserError(
            f"{path} does not match its manifest: restore it, or run `merge-sumo train --only "
            f"{name}`"
        )
    inputs = FEATURES + (SVO_FEATURES if name == "pov2" else 0)
    try:
        return QNetwork.from_tensors(load(content), inputs)
    except (SafetensorError, KeyError, ValueError, TypeError, IndexError, OverflowError) as error:
        raise UserError(f"{path} is not an action-value network: {error}") from error


def load_driver(name: str, corridors: int, folder: Path | None = None) -> LevelKDriver:
    """Load a network, and return the driver that acts by it.

    Args:
        name: name of the network, such as "vut1".
        corridors: number of corridors, K.
        folder: folder of policies; None for the shipped ones of us23.

    Raises:
        UserError: if the network is missing, or is not the file of its manifest.
    """
    return LevelKDriver(corridors, load_network(name, folder))


VUTS = {
    f"level{level}": BuiltInVut(partial(load_driver, name), network=name, ramp_only=True)
    for level, name in ((1, "vut1"), (2, "vut2"))
}
