"""The learned drivers of a folder: trained where they are missing, and measured."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from merge_sumo import config
from merge_sumo.drivers.policies import NETWORKS, plays_as, policies_of, read_manifest, scenario_of
from merge_sumo.errors import UserError
from merge_sumo.result import Result
from merge_sumo.scenario.scenario import US23, Scenario
from merge_sumo.training.check import PolicyCheck, check_policy
from merge_sumo.training.ddqn import TrainingProgress
from merge_sumo.training.helix import train_library


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
