"""The plan of a simulation: everything that decides the outcome of a case."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from merge_sumo.controllers.kinds import runs_code
from merge_sumo.controllers.spec import HERE, ControllerKind
from merge_sumo.errors import UserError
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.measures import MEASURES
from merge_sumo.road.road import Road
from merge_sumo.scenario.scenario import OWN, Scenario
from merge_sumo.simulation.povs import Povs
from merge_sumo.workers import AUTO, AnyWorkers, number_of_workers

MAX_CORRIDORS = 32
"""Episodes that one process runs at a time."""
FEW = 1000
"""Cases of built-in drivers that one process runs before others have started and share them."""


class Engine(StrEnum):
    """The engine that moves the vehicles of a case."""

    SUMO = "sumo"
    KINEMATIC = "kinematic"
    """Eq. (4) alone, with a share of the cases in SUMO, too (`kinematic_simulator.py`)."""


def versions() -> dict[str, str]:
    """Return the versions of the software that decide the outcome of a case.

    Packages that bring measures are included, because records and verdicts depend on them.
    """
    found = {"python": platform.python_version()}
    packages = ("merge-sumo", "libsumo", "numpy", "scipy", "scikit-learn")
    for package in (*packages, *MEASURES.packages):
        found[package] = installed_version(package)
    return found


installed_version = cache(version)
"""The version of a package as it was when this process first asked, and loaded it."""


@dataclass(frozen=True, kw_only=True, slots=True)
class SimulationPlan:
    """Everything that a process needs to run cases; it travels to workers with every chunk.

    Example:
        plan = CampaignSettings(vut="design2", levels=(0,), scenario=US23).load_plan()
        episodes = simulate(plan.with_engine("kinematic"), cases)

    Attributes:
        scenario: the scenario, with its follow-up after M.
        road: the road on which it takes place.
        vut: the VUT.
        povs: the drivers of the mainline.
        criterion: when a case fails.
        against: an earlier version of the VUT, with which each case runs, too.
        engine: moves the vehicles; SUMO in campaigns.
        corridors: how many episodes SUMO runs at once; it does not change their outcomes.
        substeps: integration steps for each step of the drivers; above 1, eq. (4) alone moves the
            vehicles.
        versions: those of the software that gives the outcomes; by default of this process.
        policies_sha256: hashes of the learned drivers; by default of those that this process finds.
    """

    scenario: Scenario
    road: Road
    vut: ControllerKind
    povs: Povs
    criterion: Criterion
    against: ControllerKind | None = None
    engine: Engine = Engine.SUMO
    corridors: int = MAX_CORRIDORS
    substeps: int = 1
    versions: Mapping[str, str] = field(default_factory=versions)
    policies_sha256: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Take the hashes of the learned drivers, unless they are given.

        Raises:
            UserError: if the scenario has sensors and the VUT does not use them.
        """
        if not self.scenario.sense.is_perfect and self.vut.vut_type is not None:
            raise UserError(
                f"the VUT {self.vut.spec} reads other cars from SUMO, so `sense` has no effect on "
                "it: remove `sense` (`act` works with every VUT)"
            )
        if not self.policies_sha256:
            object.__setattr__(self, "policies_sha256", self.povs.sha256())

    def key(self, level: int = OWN) -> dict[str, Any]:
        """Return everything that decides the outcomes of cases at a level, as values for JSON.

        The files of a VUT are left out, because all of them are known only after it drove. Where
        code of a user runs, the working folder is included, because the same name may be another
        file in another folder.

        Args:
            level: the POV level; by default own, which includes the POV of the user.
        """
        own = self.povs.own if level == OWN else None
        vut, pov = str(self.vut.spec), None if own is None else str(own.spec)
        code = runs_code(vut) or (pov is not None and runs_code(pov))
        return {
            "vut": vut,
            "deadline_s": self.vut.options.deadline_s,
            "pov": pov,
            "folder": str(Path.cwd()) if code else None,
            "policies_sha256": dict(self.policies_sha256),
            "road_sha256": self.road.sha256,
            "scenario": self.scenario.to_record(),
            "criterion": asdict(self.criterion),
            "versions": dict(self.versions),
        }

    @property
    def earlier(self) -> SimulationPlan | None:
        """The plan of the earlier version of the VUT, if the cases run with one."""
        if self.against is None:
            return None
        return replace(self, vut=self.against, against=None)

    def at_level(self, level: int) -> SimulationPlan:
        """Return the plan for the cases of a level: without the POV of the user at other levels.

        Args:
            level: the POV level.
        """
        if level == OWN:
            return self
        return replace(self, povs=replace(self.povs, own=None))

    def for_verdicts(self) -> SimulationPlan:
        """Return the plan for verdicts alone: without a follow-up, if they are those of M."""
        if not self.criterion.is_of_paper or self.scenario.lane_m is not None:
            return self
        return replace(self, scenario=replace(self.scenario, follow_up_s=0.0))

    def with_engine(self, engine: str | None) -> SimulationPlan:
        """Return the plan with an engine.

        Args:
            engine: name of the engine; None for the kinematic one where the drivers allow it.

        Raises:
            UserError: if the name is unknown, or the drivers do not allow the engine.
        """
        if engine is None:
            engine = Engine.KINEMATIC if self.needs_sumo is None else Engine.SUMO
        if engine not in list(Engine):
            raise UserError(f"unknown engine {engine!r}: choose {' or '.join(Engine)}")
        if engine == Engine.KINEMATIC and self.needs_sumo is not None:
            raise UserError(f"`engine` kinematic: {self.needs_sumo}; set `engine` to sumo")
        return replace(self, engine=Engine(engine))

    @property
    def needs_sumo(self) -> str | None:
        """The reason why cases need SUMO; None if eq. (4) suffices."""
        if self.povs.own is not None:
            return f"the POV {self.povs.own.spec} is not built in"
        if self.vut.own_code or self.vut.asks_sumo:
            return f"the VUT {self.vut.spec} is not built in"
        return None

    @property
    def asks_sumo(self) -> bool:
        """Whether the VUT, or the POV of the user, asks SUMO anything."""
        own = self.povs.own
        return self.vut.asks_sumo or (own is not None and own.asks_sumo)

    def workers(self, requested: AnyWorkers, cases: int | None = None) -> int | str:
        """Return the number of processes that run cases, or the address of a Dask scheduler.

        With more than one, the processes that loaded the controllers end, because each worker
        starts its own.

        Args:
            requested: the number or the address; None and "auto" for one a core, as far as the
                controllers can serve them and more than one pays.
            cases: number of cases of a campaign; None for a study.

        Raises:
            UserError: if more are requested than a controller can serve.
        """
        kinds = [kind for kind in (self.vut, self.against, self.povs.own) if kind is not None]
        if any(kind.spec.kind == HERE for kind in kinds):
            return 1
        if isinstance(requested, str) and requested != AUTO:
            return requested
        count, is_auto = number_of_workers(requested), requested in (None, AUTO)
        if is_auto and self.needs_sumo is None and cases is not None and cases <= FEW:
            count = 1
        for kind in kinds:
            if kind.max_workers is None or count <= kind.max_workers:
                continue
            if not is_auto:
                raise UserError(
                    f"`workers` is {requested}: {kind.spec} allows at most {kind.max_workers}"
                )
            count = kind.max_workers
        if count > 1:
            for kind in kinds:
                kind.release()
        return count

    def for_cases(self, cases: int) -> SimulationPlan:
        """Return the plan with no more corridors than there are cases to run at a time.

        Args:
            cases: number of cases.
        """
        return replace(self, corridors=min(self.corridors, cases))

    def with_log(self, log: Path) -> SimulationPlan:
        """Return the plan with a file for the output of the drivers of the user.

        Args:
            log: the file.
        """
        against = None if self.against is None else self.against.with_log(log)
        povs = self.povs.with_log(log)
        return replace(self, vut=self.vut.with_log(log), against=against, povs=povs)

    def check_software(self) -> None:
        """Raise `UserError` where the software of this process would give other outcomes."""
        for name, (expected, present) in differences(dict(self.versions), versions()).items():
            raise UserError(
                f"a worker has {name} {present}, but this process has {expected}: install the "
                "same version on both"
            )
        for name in differences(dict(self.policies_sha256), self.povs.sha256()):
            raise UserError(
                f"a worker has no policy {name} in {self.povs.policies}, or another one: copy the "
                "files of this process there"
            )


def differences(was: Any, now: Any, name: str = "") -> dict[str, tuple[Any, Any]]:
    """Compare two records.

    Args:
        was: the earlier record.
        now: the present record.
        name: name of the record, before a dot.

    Returns:
        Both values of each entry that differs, by its name; None for a missing one.
    """
    if isinstance(was, dict) and isinstance(now, dict):
        differing: dict[str, tuple[Any, Any]] = {}
        for key in now | was:
            inner = f"{name}.{key}" if name else key
            differing |= differences(was.get(key), now.get(key), inner)
        return differing
    was, now = (list(value) if isinstance(value, tuple) else value for value in (was, now))
    return {} if was == now else {name: (was, now)}
