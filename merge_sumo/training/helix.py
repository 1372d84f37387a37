"""The double helix: each level-k driver is trained against level k-1 (Wang et al., Fig. 2b).

The two networks of a level are trained in parallel, in a process each: first by DDQN (`ddqn`), then
by refinement (`refine`). Then they are checked in SUMO (`check`).
"""

from __future__ import annotations

import hashlib
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any, cast

import numpy as np
from safetensors.numpy import save

from merge_sumo import config
from merge_sumo.drivers.levelk import LIMIT, QNetwork
from merge_sumo.drivers.policies import (
    MANIFEST,
    NETWORKS,
    plays_as,
    policies_of,
    read_manifest,
    scenario_of,
    scenario_record,
)
from merge_sumo.errors import UserError
from merge_sumo.files import check_own, make_folder, replace_own, write_new, writing
from merge_sumo.records import to_json, to_plain
from merge_sumo.result import Result
from merge_sumo.road.loader import road_for
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.spawning import forget_safe_path, without_cwd, without_main
from merge_sumo.training.check import OPPONENTS, PolicyCheck, check_policy, game_of
from merge_sumo.training.ddqn import DdqnSettings, TrainingProgress, train
from merge_sumo.training.game import Game, of_two
from merge_sumo.training.refine import RefineSettings, refine
from merge_sumo.training.reward import RewardWeights
from merge_sumo.workers import leave_signals_to_parent

PAIRS: tuple[tuple[str, ...], ...] = (NETWORKS[:2], NETWORKS[2:])
"""The networks of a level, which do not depend on each other."""
LOG = ".training.jsonl"
WEIGHTS = ".safetensors"


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingSettings:
    """Settings of the training of a network, and the number of cases of its check."""

    ddqn: DdqnSettings = field(default_factory=DdqnSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    check_cases: int = 300


LEVEL_SETTINGS = {
    1: TrainingSettings(),
    2: TrainingSettings(
        refine=RefineSettings(rounds=30, starts=2_000, midway=0.05, searched=400, updates=3_000)
    ),
}
"""Settings by the level of the driver. An opponent that reacts makes the game harder: level 2 takes
more games, nearly all from starts of the pool, and more updates. Level 1 is refined less: with more
refinement, level 2 stayed farther from its own best response (`policies/README.md`)."""


def train_library(
    folder: Path,
    names: tuple[str, ...] = NETWORKS,
    seed: int = 0,
    *,
    scenario: Scenario,
    a_min_mps2: float | None = None,
    on_progress: Callable[[TrainingProgress], None] = lambda _: None,
    say: Callable[[str], None] = lambda _: None,
) -> None:
    """Train networks into a folder, in the order of the helix; finished ones are kept.

    A network that the manifest of the folder already has with the same scenario, seed, weights,
    settings and opponent is not trained again, so an interrupted training continues with the
    others. Each network has a log, `NAME.training.jsonl`.

    Args:
        folder: folder of the networks and their manifest.
        names: networks that are trained.
        seed: seed of every network.
        scenario: the scenario that is played.
        a_min_mps2: hardest braking of the POVs; the VUTs keep the limit of the scenario.
        on_progress: called with the progress of each network.
        say: called with a sentence about each network that is ready.

    Raises:
        UserError: if the limit does not fit the scenario, the scenario has no road, an opponent is
            missing or of another scenario, the folder has such a network of another plan, or the
            folder cannot be written or has other contents.
    """
    scenario = of_two(scenario)
    if a_min_mps2 is not None and not scenario.a_min_mps2 <= a_min_mps2 < 0.0:
        raise UserError(
            f"`a_min` is {a_min_mps2:g} m/s2: choose a number from {scenario.a_min_mps2:g} to "
            "below 0"
        )
    road_for(scenario)  # the check needs it in the end
    _make_library(folder)
    for level, pair in enumerate(PAIRS, start=1):
        settings = LEVEL_SETTINGS[level]
        plans: dict[str, dict[str, Any]] = {}
        games: dict[str, Game] = {}
        for name in pair:
            if name not in names:
                continue
            plan = plans[name] = _plan(folder, name, seed, scenario, settings, a_min_mps2)
            trained = read_manifest(folder).get(name)
            if trained is None:
                games[name] = game_of(name, folder, scenario, plan[LIMIT])
            elif not _follows(trained, plan):
                raise UserError(
                    f"{folder} has a {name} of another scenario, seed, opponent or setting: "
                    "choose another folder with `out`, or remove it first"
                )
        _train_in_parallel(folder, games, plans, settings, on_progress)
        for name in plans:
            entry = read_manifest(folder)[name]
            if "check" in entry:
                say(f"{name} exists already")
                continue
            check = check_policy(name, folder, settings.check_cases, scenario)
            _write_entry(folder, name, {**entry, "check": to_plain(check)})
            say(f"{name} is ready")


def _make_library(folder: Path) -> None:
    """Create a folder of policies with an empty manifest; keep an existing one.

    Raises:
        UserError: if the folder has other contents and no manifest.
    """
    make_folder(folder, exist_ok=True)
    manifest = folder / MANIFEST
    files = [folder / f"{name}{end}" for name in NETWORKS for end in (LOG, WEIGHTS)]
    check_own(manifest, *files)
    if manifest.is_file():
        return
    with writing(folder):
        if any(folder.iterdir()):
            raise UserError(
                f"{folder} has other files than policies: choose another folder with `out`"
            )
    write_new(manifest, to_json({"networks": {}}, indent=2))


def _follows(entry: dict[str, Any], plan: dict[str, Any]) -> bool:
    """Return whether the entry of a manifest follows a plan; names of scenarios may differ."""
    same = all(entry.get(key) == plan[key] for key in plan if key != "scenario")
    return same and plays_as(scenario_of(entry), scenario_of(plan))


def _plan(
    folder: Path,
    name: str,
    seed: int,
    scenario: Scenario,
    settings: TrainingSettings,
    a_min_mps2: float | None,
) -> dict[str, Any]:
    """Return everything that decides the weights of a network."""
    role, opponent = OPPONENTS[name]
    entry = read_manifest(folder).get(opponent)
    if entry is not None and not plays_as(scenario_of(entry), scenario):
        raise UserError(
            f"the {opponent} of {folder} was trained for another scenario, "
            f"{scenario_of(entry).name}: choose another folder with `out`"
        )
    return {
        "scenario": scenario_record(scenario),
        "role": role,
        "opponent": opponent,
        "opponent_sha256": None if entry is None else entry["sha256"],
        "seed": seed,
        "reward_weights": to_plain(RewardWeights.of(scenario)),
        "settings": to_plain(settings),
        LIMIT: a_min_mps2 if role == "pov" else None,
    }


def _train_in_parallel(
    folder: Path,
    games: dict[str, Game],
    plans: dict[str, dict[str, Any]],
    settings: TrainingSettings,
    on_progress: Callable[[TrainingProgress], None],
) -> None:
    """Train a network for each game, in a process each; write their logs and the networks.

    Raises:
        UserError: if a file cannot be written, or a process ends before its network is trained.
    """
    # Spawned, because libsumo's simulation must not be forked.
    context = get_context("spawn")
    names: dict[Connection, str] = {}
    logs = dict.fromkeys(games, b"")
    with ExitStack() as opened:
        for name, game in games.items():
            receiver, sender = context.Pipe(duplex=False)
            task = sender, game, plans[name]["seed"], settings
            process = context.Process(target=_train_one, args=task)
            with without_main(), without_cwd():
                process.start()
            # An interrupted training does not wait for the hour that a process still needs.
            opened.callback(process.kill)
            sender.close()
            names[receiver] = name
        while names:
            for receiver in cast(list[Connection], wait(list(names))):
                name = names[receiver]
                try:
                    message = receiver.recv()
                except EOFError as error:
                    raise UserError(
                        f"the process that trains {name} has ended: free memory, then run the "
                        "command again"
                    ) from error
                if isinstance(message, TrainingProgress):
                    progress = replace(message, network=name)
                    logs[name] += to_json(progress)
                    replace_own(folder / f"{name}{LOG}", logs[name])
                    on_progress(progress)
                else:
                    network, seconds = message
                    _keep(folder, name, network, {**plans[name], "training_s": round(seconds, 1)})
                    del names[receiver]


def _train_one(sender: Connection, game: Game, seed: int, settings: TrainingSettings) -> None:
    """Train a network by DDQN and refine it; send the progress, then the result."""
    forget_safe_path()
    leave_signals_to_parent()
    started = time.perf_counter()
    network = train(game, seed, settings.ddqn, sender.send)
    network = refine(game, network, seed, settings.refine, sender.send)
    sender.send((network, time.perf_counter() - started))


def _keep(folder: Path, name: str, network: QNetwork, entry: dict[str, Any]) -> None:
    """Write a network, then its entry in the manifest."""
    tensors = {}
    for i, (weight, bias) in enumerate(network.layers):
        tensors[f"{i}.weight"] = weight.astype("float32")
        tensors[f"{i}.bias"] = bias.astype("float32")
    if network.a_min_mps2 is not None:
        # In the file, so that its hash covers the limit, too.
        tensors[LIMIT] = np.array([network.a_min_mps2])
    content = save(tensors)
    replace_own(folder / f"{name}{WEIGHTS}", content)
    versions = {package: version(package) for package in ("torch", "numpy", "libsumo")}
    sha256 = hashlib.sha256(content).hexdigest()
    _write_entry(folder, name, {**entry, "sha256": sha256, "versions": versions})


def _write_entry(folder: Path, name: str, entry: dict[str, Any]) -> None:
    known = {**read_manifest(folder), name: entry}
    entries = {name: known[name] for name in NETWORKS if name in known}
    replace_own(folder / MANIFEST, to_json({"networks": entries}, indent=2))


class PolicyChecks(Result, dict[str, PolicyCheck]):
    """The check of each trained network, by its name. `ms.train` returns it.

    Each value compares a network with its best response, over random cases of the pool: its mean
    regret, its 99th percentile, and its collisions.
    """

    def lines(self) -> list[str]:
        """Return the checks as a table."""
        lines = ["network  mean regret  p99 regret  collisions  avoidable"]
        for name, check in self.items():
            lines.append(
                f"{name:<7}  {check.mean_regret:11.2%}  {check.p99_regret:10.2%}  "
                f"{check.collisions:10d}  {check.avoidable_collisions:9d}"
            )
        return lines


def train_and_check(
    settings: config.Train,
    scenario: Scenario | None,
    on_part: Callable[[str, int, int, str, str], None],
    say: Callable[[str], None],
) -> PolicyChecks:
    """Train the learned drivers, or only check those in a folder.

    Args:
        settings: the networks, their folder and their seed.
        scenario: the scenario; None for the paper's.
        on_part: called with the name of a part, the progress in it, its total and unit, and a note.
        say: called with a sentence about each network.

    Returns:
        The regret of each network.

    Raises:
        UserError: for an unknown network, or an unknown folder.
    """
    wanted = set(settings.only or NETWORKS)
    if unknown := wanted - set(NETWORKS):
        raise UserError(f"unknown network {min(unknown)!r}: choose {', '.join(NETWORKS)}")
    names, played = tuple(name for name in NETWORKS if name in wanted), scenario or US23
    folder = policies_of(played) if settings.out is None else Path(settings.out)
    if not settings.check:
        if settings.out is None and not plays_as(played, US23):
            raise UserError(
                f"the shipped policies are for {US23.name}: set `out` to a folder for the "
                f"policies of {played.name}"
            )

        def progressed(now: TrainingProgress) -> None:
            note = f"return {now.mean_return:.3f}"
            on_part(f"{now.network} {now.stage}", now.done, now.total, "updates", note)

        train_library(
            folder,
            names,
            settings.seed,
            scenario=played,
            a_min_mps2=settings.a_min,
            on_progress=progressed,
            say=say,
        )
    manifest = read_manifest(folder)
    trained_for = scenario_of(manifest.get(names[0], {}))
    if scenario is None and not plays_as(trained_for, US23):
        raise UserError(
            f"{folder} was trained for {trained_for.name}: set `scenario` to the one to check it "
            f"in, {trained_for.name} or {US23.name}"
        )
    checks = PolicyChecks()
    for name in names:
        if settings.check:
            checks[name] = check_policy(name, folder, settings.cases, played)
        else:
            checks[name] = PolicyCheck(**manifest[name]["check"])
    return checks
