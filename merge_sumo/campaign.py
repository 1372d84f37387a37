"""The conductor: a sampler proposes, the world runs, the journal remembers."""

from __future__ import annotations

import platform
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final, Self

from merge_sumo.case import Case, Pool
from merge_sumo.drivers.policies import read_manifest
from merge_sumo.drivers.pov import PovLibrary, available_levels
from merge_sumo.drivers.vut import vut_factory
from merge_sumo.errors import UserError
from merge_sumo.journal import Journal, Run, failures
from merge_sumo.rollout import rollout
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.registry import DEFAULT_SAMPLER, make_sampler
from merge_sumo.scenario import LEVELS, V_VUT0_MAX_MPS, V_VUT0_MPS
from merge_sumo.score import Outcome, measure
from merge_sumo.sumo.net import Net
from merge_sumo.sumo.replay import write_scenario
from merge_sumo.sumo.world import World
from merge_sumo.trajectory import Trajectory

DEFAULT_CASES: Final = 800
DEFAULT_BATCH: Final = 40
MAX_CORRIDORS: Final = 32
EXPORTED_FAILURES: Final = 10
SCENARIOS: Final = "scenarios"

OnCase = Callable[[Outcome], None]
"""Told of every case as it ends, in the order in which cases end."""


@dataclass(frozen=True, kw_only=True, slots=True)
class CampaignSettings:
    """Everything that decides what a campaign does; `UserError` for values that make none."""

    vut: str
    levels: tuple[int, ...]
    sampler: str = DEFAULT_SAMPLER
    cases: int = DEFAULT_CASES
    batch: int = DEFAULT_BATCH
    seed: int = 0
    v_vut0_mps: float = V_VUT0_MPS

    def __post_init__(self) -> None:
        """Check the numbers, the names and the levels."""
        vut_factory(self.vut)
        make_sampler(self.sampler, self.pool, self.seed)
        for name in ("cases", "batch"):
            if getattr(self, name) < 1:
                raise UserError(f"--{name} is {getattr(self, name)}: it must be 1 or more")
        if self.batch > self.cases:
            raise UserError(
                f"--batch is {self.batch} and --cases is {self.cases}: a batch cannot have more "
                "cases than the campaign"
            )
        if self.seed < 0:
            raise UserError(f"--seed is {self.seed}: it must be 0 or more")
        if not 0.0 <= self.v_vut0_mps <= V_VUT0_MAX_MPS:
            raise UserError(
                f"--v-vut0 is {self.v_vut0_mps}: choose between 0 and {V_VUT0_MAX_MPS:g} m/s"
            )

    @property
    def pool(self) -> Pool:
        """The cases to choose from."""
        return Pool(levels=self.levels, v_vut0_mps=self.v_vut0_mps)


def parse_levels(text: str) -> tuple[int, ...]:
    """Return the levels that `--level` names: one, or all for which there is a policy."""
    available = available_levels()
    if text == "all":
        return available
    if text not in map(str, LEVELS):
        raise UserError(f"there is no POV level {text!r}: choose 0, 1, 2 or all")
    level = int(text)
    if level not in available:
        raise UserError(
            f"there is no policy for a POV of level {level}: run `merge-sumo train` to make it"
        )
    return (level,)


def one_level(text: str) -> int:
    """Return the one level that `--level` names."""
    if text == "all":
        raise UserError("--level all does not go here: choose 0, 1 or 2")
    return parse_levels(text)[0]


def versions() -> dict[str, str]:
    """Return the versions that decide the outcome of a case."""
    packages = ("merge-sumo", "libsumo", "numpy", "scipy", "scikit-learn")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


class ProvingGround:
    """A VUT and the POV library in a SUMO world: takes cases, gives trajectories."""

    def __init__(self, vut: str, corridors: int = MAX_CORRIDORS, net: Net | None = None) -> None:
        """Start SUMO and the VUT."""
        self.world = World(corridors, net)
        try:
            self.vut = vut_factory(vut)(corridors)
            self.pov = PovLibrary(corridors)
        except BaseException:
            self.world.close()
            raise

    def run(self, cases: Iterable[Case]) -> Iterator[tuple[int, Trajectory]]:
        """Run cases; yield (place in `cases`, trajectory) as they end."""
        return rollout(self.world, self.pov, self.vut, cases)

    def __enter__(self) -> Self:
        """Return the proving ground."""
        return self

    def __exit__(self, *_: object) -> None:
        """Stop the VUT, then SUMO."""
        try:
            self.vut.close()
        finally:
            self.world.close()


def conduct(
    sampler: Sampler,
    ground: ProvingGround,
    cases: int,
    batch: int,
    on_case: OnCase | None = None,
) -> Iterator[list[tuple[Outcome, Trajectory]]]:
    """Ask, run, tell, batch by batch; yield what each batch gave, in order of the cases."""
    for number, first in enumerate(range(0, cases, batch)):
        ran: list[tuple[Outcome, Trajectory]] = []
        for place, trajectory in ground.run(sampler.ask(min(batch, cases - first))):
            outcome = Outcome(first + place, number, trajectory.case, measure(trajectory))
            ran.append((outcome, trajectory))
            if on_case is not None:
                on_case(outcome)
        ran.sort(key=lambda pair: pair[0].index)
        sampler.tell(outcome for outcome, _ in ran)
        yield ran


def run_campaign(
    settings: CampaignSettings, folder: Path, net: Net | None = None, on_case: OnCase | None = None
) -> Run:
    """Run a campaign into a new folder and return it as read back from there.

    Same settings, same versions: same `outcomes.jsonl`. The worst failures are exported as
    folders that sumo-gui opens. Raises `UserError` when the folder exists.
    """
    net = net or Net()
    sampler = make_sampler(settings.sampler, settings.pool, settings.seed)
    with ProvingGround(settings.vut, min(MAX_CORRIDORS, settings.batch), net) as ground:
        journal = Journal(folder, record_of(settings, net))
        for ran in conduct(sampler, ground, settings.cases, settings.batch, on_case):
            journal.append(ran)
    run = Run(folder)
    for outcome in failures(run.outcomes)[:EXPORTED_FAILURES]:
        export_case(run, outcome.index, folder / SCENARIOS / case_name(outcome.index), net)
    return run


def record_of(settings: CampaignSettings, net: Net) -> dict[str, Any]:
    """Return what `campaign.json` holds: everything that decides the outcomes."""
    policies = {name: entry["sha256"] for name, entry in read_manifest().items()}
    return {
        **asdict(settings),
        "versions": versions(),
        "net_sha256": net.sha256,
        "policies_sha256": policies,
    }


def case_name(index: int) -> str:
    """Return the name of a case's folder."""
    return f"case-{index:05d}"


def export_case(run: Run, index: int, folder: Path, net: Net | None = None) -> Path:
    """Write a case of a run as a replay folder; return the path of its SUMO configuration."""
    return write_scenario(folder, net or Net(), run.outcome(index), run.trajectory(index))
