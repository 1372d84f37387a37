"""The double helix: each level-k driver is trained against level k-1 (Wang et al., Fig. 2b)."""

from __future__ import annotations

import hashlib
import json
import time
from collections.abc import Callable
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

from safetensors.numpy import save

from merge_sumo.drivers.levelk import QNetwork
from merge_sumo.drivers.policies import MANIFEST, NETWORKS, load_driver, read_manifest
from merge_sumo.errors import UserError
from merge_sumo.training.check import CHECK_CASES, PolicyCheck, check_policy
from merge_sumo.training.ddqn import TrainingProgress, TrainingSettings, train
from merge_sumo.training.env import MergeGame, Role, make_opponent
from merge_sumo.training.reward import RewardWeights

OPPONENTS: Final[dict[str, tuple[Role, str]]] = {
    "pov1": ("pov", "level0"),
    "vut1": ("vut", "level0"),
    "pov2": ("pov", "vut1"),
    "vut2": ("vut", "pov1"),
}
"""Role and opponent of each network, in the order of the helix."""
# What level 2 gains over level 0 is small, because level 1 makes room for it: so precision.
_LEVEL_2: Final = TrainingSettings(
    updates=140_000,
    transitions=1_000_000,
    collecting=0.7,
    last_exploration=0.05,
    last_midway=0.15,
)
SETTINGS: Final = {
    "pov1": TrainingSettings(),
    "vut1": TrainingSettings(),
    "pov2": _LEVEL_2,
    "vut2": _LEVEL_2,
}
GAMES: Final = 64
"""Corridors in which transitions are collected."""

OnProgress = Callable[[str, TrainingProgress, int], None]
"""Told the network, where its training is, and how many updates there will be."""


def train_library(
    folder: Path,
    names: tuple[str, ...] = NETWORKS,
    seed: int = 0,
    weights: RewardWeights | None = None,
    settings: TrainingSettings | None = None,
    *,
    check_count: int = CHECK_CASES,
    on_progress: OnProgress | None = None,
    on_done: Callable[[str, PolicyCheck | None], None] | None = None,
) -> None:
    """Train networks into a folder, in the order of the helix; finished ones are kept.

    A network that the folder's manifest already has with the same seed, weights, settings and
    opponent is not trained again, so an interrupted training goes on where it stood. Next to each
    network lies a log, `<name>.training.jsonl`. Raises `UserError` when an opponent is missing, the
    folder has such a network of another plan, or the folder cannot be written.
    """
    weights = weights or RewardWeights()
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot write {folder}: {error.strerror}") from error
    for name in (name for name in NETWORKS if name in names):
        chosen = settings or SETTINGS[name]
        plan = _plan(folder, name, seed, weights, chosen)
        known = read_manifest(folder).get(name, {})
        if {key: known.get(key) for key in plan} == plan:
            if on_done is not None:
                on_done(name, None)
            continue
        if known:
            raise UserError(
                f"{folder} has a {name} of another seed, opponent or setting: choose another "
                "folder with --out, or remove it first"
            )
        network, seconds = _train_one(folder, name, seed, weights, chosen, on_progress)
        content = save(
            {
                f"{i}.{part}": tensor.astype("float32")
                for i, layer in enumerate(network.layers)
                for part, tensor in zip(("weight", "bias"), layer, strict=True)
            }
        )
        entry = {
            **plan,
            "sha256": hashlib.sha256(content).hexdigest(),
            "training_s": round(seconds, 1),
            "versions": {package: version(package) for package in ("torch", "numpy", "libsumo")},
        }
        (folder / f"{name}.safetensors").write_bytes(content)
        _write_entry(folder, name, entry)
        checked = check_policy(name, folder, weights, check_count)
        _write_entry(folder, name, {**entry, "check": asdict(checked)})
        if on_done is not None:
            on_done(name, checked)


def _plan(
    folder: Path, name: str, seed: int, weights: RewardWeights, settings: TrainingSettings
) -> dict[str, Any]:
    """Return everything that decides the weights of a network."""
    role, opponent = OPPONENTS[name]
    opponent_sha256 = None
    if opponent != "level0":
        entry = read_manifest(folder).get(opponent)
        if entry is None:
            raise UserError(f"{name} is trained against {opponent}: train that one first")
        opponent_sha256 = entry["sha256"]
    return {
        "command": f"merge-sumo train --only {name} --seed {seed}",
        "role": role,
        "opponent": opponent,
        "opponent_sha256": opponent_sha256,
        "seed": seed,
        "reward_weights": asdict(weights),
        "settings": asdict(settings),
    }


def _train_one(
    folder: Path,
    name: str,
    seed: int,
    weights: RewardWeights,
    settings: TrainingSettings,
    on_progress: OnProgress | None,
) -> tuple[QNetwork, float]:
    role, opponent_name = OPPONENTS[name]
    if opponent_name == "level0":
        opponent = make_opponent(role, opponent_name, GAMES)
    else:
        opponent = load_driver(opponent_name, GAMES, folder)
    started = time.perf_counter()
    game = MergeGame(role, opponent, weights)
    try:
        with (folder / f"{name}.training.jsonl").open("w", encoding="utf-8") as log:

            def progress(now: TrainingProgress) -> None:
                values = asdict(now)
                del values["network"]
                log.write(json.dumps(values) + "\n")
                log.flush()
                if on_progress is not None:
                    on_progress(name, now, settings.updates)

            network = train(game, seed, settings, sees_svo=name == "pov2", on_progress=progress)
    finally:
        game.close()
    return network, time.perf_counter() - started


def _write_entry(folder: Path, name: str, entry: dict[str, Any]) -> None:
    networks = {**read_manifest(folder), name: entry}
    text = json.dumps({"networks": {n: networks[n] for n in NETWORKS if n in networks}}, indent=2)
    (folder / MANIFEST).write_text(text + "\n", encoding="utf-8")
