"""The double helix: each level-k driver is trained against level k-1 (Wang et al., Fig. 2b).

The two networks of a level do not depend on each other and are trained in parallel, in a process
each. A network is first trained by DDQN (`ddqn`), then refined (`refine`), then checked in SUMO.
"""

from __future__ import annotations

import hashlib
import json
import queue
import time
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor, wait
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from importlib.metadata import version
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from safetensors.numpy import save

from merge_sumo import config
from merge_sumo.drivers.levelk import LIMIT, QNetwork
from merge_sumo.drivers.policies import (
    MANIFEST,
    NETWORKS,
    load_network,
    plays_as,
    policies_of,
    read_manifest,
    scenario_of,
    scenario_record,
)
from merge_sumo.errors import UserError
from merge_sumo.files import (
    cannot_write,
    check_own,
    make_folder,
    replace_own,
    write_new,
)
from merge_sumo.printable import quoted
from merge_sumo.records import to_json, to_plain
from merge_sumo.result import Result
from merge_sumo.road.merge import road_for
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.spawning import forget_safe_path, without_cwd
from merge_sumo.training.check import CHECK_CASES, PolicyCheck, check_network, check_policy
from merge_sumo.training.ddqn import DdqnSettings, TrainingProgress, train
from merge_sumo.training.game import Game, of_two
from merge_sumo.training.refine import RefineSettings, refine
from merge_sumo.training.reward import Reward, RewardWeights, Role
from merge_sumo.workers import leave_signals_to_parent

OPPONENTS: dict[str, tuple[Role, str]] = {
    "pov1": ("pov", "level0"),
    "vut1": ("vut", "level0"),
    "pov2": ("pov", "vut1"),
    "vut2": ("vut", "pov1"),
}
"""Role and opponent of each network, in the order of the helix."""
PAIRS: tuple[tuple[str, ...], ...] = (NETWORKS[:2], NETWORKS[2:])
"""The networks of a level, which do not depend on each other."""
LOG = ".training.jsonl"
WEIGHTS = ".safetensors"


@dataclass(frozen=True, kw_only=True, slots=True)
class TrainingSettings:
    """Settings of the training of a network, and the number of cases of its check."""

    ddqn: DdqnSettings = field(default_factory=DdqnSettings)
    refine: RefineSettings = field(default_factory=RefineSettings)
    check_cases: int = CHECK_CASES


LEVEL_SETTINGS = {
    1: TrainingSettings(),
    2: TrainingSettings(
        refine=RefineSettings(rounds=30, starts=2_000, midway=0.05, searched=400, updates=3_000)
    ),
}
"""Settings by the level of the driver. An opponent that reacts makes the game harder: level 2 takes
more games, nearly all from the pool's own starts, and more updates. Level 1 is refined less: with
more refinement, level 2 stayed farther from its own best response (`policies/README.md`)."""


_Task = tuple[str, Game, int, TrainingSettings]
"""Name, game, seed and settings of a network, for the process that trains it."""


def train_library(
    folder: Path,
    names: tuple[str, ...] = NETWORKS,
    seed: int = 0,
    weights: RewardWeights | None = None,
    settings: TrainingSettings | None = None,
    *,
    scenario: Scenario,
    a_min_mps2: float | None = None,
    on_progress: Callable[[TrainingProgress], None] | None = None,
    on_done: Callable[[str, PolicyCheck | None], None] | None = None,
) -> None:
    """Train networks into a folder, in the order of the helix; finished ones are kept.

    A network that the folder's manifest already has with the same scenario, seed, weights,
    settings and opponent is not trained again, so an interrupted training goes on with what is not
    finished. Next to each network lies a log, `<name>.training.jsonl`.

    Args:
        folder: folder of the networks and their manifest.
        names: networks that are trained.
        seed: seed of every network.
        weights: weights of the reward; by default those of the scenario.
        settings: settings of every network; by default those of its level.
        scenario: the scenario that is played.
        a_min_mps2: hardest braking of the POVs; the VUTs keep the scenario's limit.
        on_progress: called with the progress of each network.
        on_done: called with the name of each network and its check, None for one that was there.

    Raises:
        UserError: if the limit does not fit the scenario, the scenario has no road, an opponent is
            missing or of another scenario, the folder has such a network of another plan, or the
            folder cannot be written or has other contents.
    """
    scenario = of_two(scenario)
    if a_min_mps2 is not None and not scenario.a_min_mps2 <= a_min_mps2 < 0.0:
        raise UserError(
            f"the hardest braking of a POV is {a_min_mps2:g} m/s2: choose a number from "
            f"{scenario.a_min_mps2:g} to below 0, such as `a_min` {scenario.a_min_mps2 / 2:g}"
        )
    reward = Reward(weights or RewardWeights.of(scenario), scenario)
    road_for(scenario)  # on which it is checked in the end
    _take(folder)
    for level, pair in enumerate(PAIRS, start=1):
        of_level = settings or LEVEL_SETTINGS[level]
        plans = {
            name: _plan(folder, name, seed, reward, of_level, a_min_mps2)
            for name in pair
            if name in names
        }
        tasks: list[_Task] = []
        for name, plan in plans.items():
            known = read_manifest(folder).get(name, {})
            if not _is_of(known, plan):
                if known:
                    raise UserError(
                        f"{folder} has a {name} of another scenario, seed, opponent or setting: "
                        "choose another folder with `out`, or remove it first"
                    )
                role, opponent = OPPONENTS[name]
                network = None if opponent == "level0" else load_network(opponent, folder)
                game = Game(role, network, reward, plan.get(LIMIT))
                tasks.append((name, game, seed, of_level))
            elif on_done is not None:
                on_done(name, None)
        for trained, network, check, seconds in _train_in_parallel(folder, tasks, on_progress):
            entry = {**plans[trained], "training_s": round(seconds, 1)}
            _keep(folder, trained, network, entry, check)
            if on_done is not None:
                on_done(trained, check)


def _take(folder: Path) -> None:
    """Create a folder of policies with an empty manifest, which marks the folder as ours.

    Raises `UserError` for a folder that has other contents and no manifest.
    """
    make_folder(folder, exist_ok=True)
    manifest = folder / MANIFEST
    files = [folder / f"{name}{end}" for name in NETWORKS for end in (LOG, WEIGHTS)]
    check_own(manifest, *files)
    if read_manifest(folder) or manifest.is_file():
        return
    try:
        if any(folder.iterdir()):
            raise UserError(
                f"{folder} holds other things than policies: choose another folder with `out`"
            )
    except OSError as error:
        raise cannot_write(folder, error) from error
    write_new(manifest, to_json({"networks": {}}, indent=2))


def _is_of(known: dict[str, Any], plan: dict[str, Any]) -> bool:
    """Return whether the entry of a manifest, perhaps empty, follows a plan."""
    others = plan.keys() - {"scenario"}
    same = all(known.get(key) == plan.get(key) for key in {*others, LIMIT})
    return same and plays_as(scenario_of(known), scenario_of(plan))


def _plan(
    folder: Path,
    name: str,
    seed: int,
    reward: Reward,
    settings: TrainingSettings,
    a_min_mps2: float | None,
) -> dict[str, Any]:
    """Return everything that decides the weights of a network; a POV may brake less."""
    role, opponent = OPPONENTS[name]
    limit = a_min_mps2 if role == "pov" else None
    of_limit = "" if a_min_mps2 is None else f" --a-min {a_min_mps2:g}"
    scenario = reward.scenario
    of_scenario = "" if plays_as(scenario, US23) else f" --scenario {quoted(scenario.name)}"
    opponent_sha256 = None
    if opponent != "level0":
        entry = read_manifest(folder).get(opponent)
        if entry is None:
            raise UserError(f"{name} is trained against {opponent}: train that one first")
        if not plays_as(scenario_of(entry), scenario):
            raise UserError(
                f"the {opponent} of {folder} was trained for another scenario, "
                f"{scenario_of(entry).name}: choose another folder with `out`"
            )
        opponent_sha256 = entry["sha256"]
    return {
        "command": f"merge-sumo train --only {name} --seed {seed}{of_scenario}{of_limit}",
        "scenario": scenario_record(scenario),
        "role": role,
        "opponent": opponent,
        "opponent_sha256": opponent_sha256,
        "seed": seed,
        "reward_weights": to_plain(reward.weights),
        "settings": to_plain(settings),
        **({} if limit is None else {LIMIT: limit}),
    }


_Trained = tuple[str, QNetwork, PolicyCheck, float]
"""Name, network, its check against the best response, and the seconds of the training."""


def _train_in_parallel(
    folder: Path, tasks: list[_Task], on_progress: Callable[[TrainingProgress], None] | None
) -> list[_Trained]:
    """Train networks in a process each; write their logs while they train."""
    if not tasks:
        return []
    context = get_context("spawn")
    for name, *_ in tasks:
        _log(folder, name, "w")
    with without_cwd():
        reports = context.Queue()
        # Spawned, because libsumo's simulation must not be forked.
        pool = ProcessPoolExecutor(len(tasks), context, _report_into, (reports,))
        results = [pool.submit(_train_one, *task) for task in tasks]
    with pool:
        running: set[Future[_Trained]] = set(results)
        try:
            while running:
                running = wait(running, timeout=0.2).not_done
                with suppress(queue.Empty):
                    while True:
                        progress: TrainingProgress = reports.get_nowait()
                        line = json.dumps(to_plain(progress)) + "\n"
                        _log(folder, progress.network, "a", line)
                        if on_progress is not None:
                            on_progress(progress)
        except BaseException:
            # An interrupted training does not wait for the hour that a process still needs.
            for process in list(pool._processes.values()):
                process.kill()
            raise
        return [result.result() for result in results]


def _log(folder: Path, name: str, mode: str, line: str = "") -> None:
    """Begin the log of a network's training, or append to it; `UserError` if that fails."""
    path = folder / f"{name}{LOG}"
    try:
        with path.open(mode, encoding="utf-8") as log:
            log.write(line)
    except OSError as error:
        raise cannot_write(path, error) from error


_reports: Any = None
"""The queue to which a training process reports."""


def _report_into(reports: Any) -> None:
    global _reports  # noqa: PLW0603 (one process, one queue)
    _reports = reports
    forget_safe_path()
    leave_signals_to_parent()


def _train_one(name: str, game: Game, seed: int, settings: TrainingSettings) -> _Trained:
    """Train a network by DDQN, refine it, check it in SUMO."""

    def report(now: TrainingProgress) -> None:
        _reports.put(replace(now, network=name))

    started = time.perf_counter()
    network = train(game, seed, settings.ddqn, sees_svo=name == "pov2", on_progress=report)
    network = refine(game, network, seed, settings.refine, report)
    seconds = time.perf_counter() - started
    check = check_network(name, network, game.opponent, game.reward, settings.check_cases)
    return name, network, check, seconds


def _keep(
    folder: Path, name: str, network: QNetwork, entry: dict[str, Any], check: PolicyCheck
) -> None:
    """Write a network, then its entry in the manifest."""
    tensors = {
        f"{i}.{part}": tensor.astype("float32")
        for i, layer in enumerate(network.layers)
        for part, tensor in zip(("weight", "bias"), layer, strict=True)
    }
    if network.a_min_mps2 is not None:
        # In the file, so that its hash covers the limit, too.
        tensors[LIMIT] = np.array([network.a_min_mps2])
    content = save(tensors)
    replace_own(folder / f"{name}{WEIGHTS}", content)
    packages = ("torch", "numpy", "libsumo")
    known = {
        **read_manifest(folder),
        name: {
            **entry,
            "sha256": hashlib.sha256(content).hexdigest(),
            "versions": {package: version(package) for package in packages},
            "check": to_plain(check),
        },
    }
    entries = {name: known[name] for name in NETWORKS if name in known}
    replace_own(folder / MANIFEST, to_json({"networks": entries}, indent=2))


class PolicyChecks(Result, dict[str, PolicyCheck]):
    """`PolicyCheck` by the name of the network."""

    def lines(self) -> list[str]:
        """Return a table of the checks."""
        return [
            "network  mean regret  p99 regret  collisions  avoidable  mean return  best  level 0",
            *(
                f"{name:<7}  {one.mean_regret:11.2%}  {one.p99_regret:10.2%}  "
                f"{one.collisions:10d}  {one.avoidable_collisions:9d}  "
                f"{one.mean_return:11.3f}  {one.mean_best:.3f}  {one.mean_level0:.3f}"
                for name, one in self.items()
            ),
        ]


def checks_of(
    asked: config.Train,
    scenario: Scenario | None,
    on_part: Callable[[str, int, int, str, str], None],
    say: Callable[[str], None],
) -> PolicyChecks:
    """Train the learned drivers, or measure those that are there, and return what each loses.

    Args:
        asked: what is trained.
        scenario: the scenario that is asked for.
        on_part: told how far it is, as of studies.
        say: told which networks are ready.

    Raises:
        UserError: for a network or a folder that is not known.
    """
    wanted = set(asked.only or NETWORKS)
    if unknown := wanted - set(NETWORKS):
        raise UserError(f"there is no network {min(unknown)!r}: choose {', '.join(NETWORKS)}")
    names, played = [name for name in NETWORKS if name in wanted], scenario or US23
    folder = policies_of(played) if asked.out is None else Path(asked.out)
    if not asked.check:

        def progressed(now: TrainingProgress) -> None:
            on_part(f"{now.network} {now.stage}", now.done, now.total, "updates", now.note)

        if asked.out is None and not plays_as(played, US23):
            raise UserError(
                f"the shipped policies are for {US23.name}: say with `out` where those for "
                f"{played.name} are to go"
            )
        train_library(
            *(folder, tuple(names), asked.seed),
            scenario=played,
            a_min_mps2=asked.a_min,
            on_progress=progressed,
            on_done=lambda n, check: say(f"{n} is {'there already' if check is None else 'ready'}"),
        )
    manifest = read_manifest(folder)
    if missing := [name for name in names if name not in manifest]:
        raise UserError(f"{folder} has no {missing[0]}: run `merge-sumo train` to make it")
    trained_for = scenario_of(manifest[names[0]])
    if scenario is None and not plays_as(trained_for, US23):
        raise UserError(
            f"{folder} was trained for {trained_for.name}: say with `scenario` in which one to "
            f"check it, or {US23.name}"
        )
    if asked.check:
        checked = partial(check_policy, count=asked.cases, scenario=played)
        return PolicyChecks({name: checked(name, folder) for name in names})
    return PolicyChecks({name: PolicyCheck(**manifest[name]["check"]) for name in names})
