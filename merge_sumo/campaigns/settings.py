"""Settings of a campaign: their record in `campaign.json`, and the plan of its simulation."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

from merge_sumo.campaigns.printed_commands import CONTROLLERS
from merge_sumo.campaigns.recorded import (
    NAME_CHARACTERS,
    SETTINGS,
    SharedSettings,
    recorded_scenario,
)
from merge_sumo.config import Search, non_defaults
from merge_sumo.controllers.in_memory import names_code
from merge_sumo.controllers.kinds import is_built_in, load, waits_for_client
from merge_sumo.controllers.spec import ControllerOptions
from merge_sumo.drivers.policies import policies_name
from merge_sumo.errors import UserError
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.printable import printable
from merge_sumo.records import RecordError, check_fields, to_plain
from merge_sumo.road.loader import road_for
from merge_sumo.samplers.base import Predictor, Sampler
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import (
    DEADLINE_S,
    MEMORY_GIB,
    OWN,
    Scenario,
)
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.simulation.povs import POLICIES, Povs, check_level, own_pov, policies_folder

DEBUG_DEADLINE_S = 86_400.0
"""Deadline of a step while a user debugs."""


@dataclass(frozen=True, kw_only=True)
class CampaignSettings(SharedSettings):
    """Everything that decides the outcomes of a campaign; `UserError` for wrong values.

    Example:
        settings = CampaignSettings(vut="design2", levels=(0,), scenario=US23, cases=100)
        run = run_campaign(settings, settings.load_plan(), Path("runs/example"))

    Attributes:
        vut: spec of the VUT.
        levels: POV levels, each once.
        pov: spec of the POV at level own.
        against: spec of an earlier version of the VUT, which runs the same cases.
        fail_when: condition of a failure.
        require: requirement in signal temporal logic; it replaces the condition.
        scenario: the scenario.
        policies: folder of the learned drivers; None for the shipped ones.
        deadline_s: time that a controller may take for a step, in s.
        vut_memory_gib: memory that the process of a controller may take, in GiB.
    """

    scenario: Scenario
    policies: str | None = None
    deadline_s: float = DEADLINE_S
    vut_memory_gib: float = MEMORY_GIB

    def __post_init__(self) -> None:
        check_fields(self)
        for name in (*CONTROLLERS, "policies"):
            text = getattr(self, name) or ""
            if text != text.encode(errors="replace").decode():
                raise UserError(
                    f"`{name}` is {text!r}: campaign.json cannot record bytes that are not UTF-8; "
                    "choose another name"
                )
        criterion = self.criterion
        object.__setattr__(self, "fail_when", criterion.fail_when)
        object.__setattr__(self, "require", criterion.require)
        criterion.check(self.scenario)
        # Both raise for wrong values.
        self._controller_options(None)
        self.new_sampler()
        if not 0.0 <= self.tolerated < 1.0:
            raise UserError(
                f"`tolerated` is {self.tolerated}: choose a share of failing runs from 0 to below "
                "1, such as 0.1"
            )
        if self.seed < 0:
            raise UserError(f"`seed` is {self.seed}: it must be 0 or more")
        for name in ("cases", "batch", "in_flight", "repeat"):
            number = getattr(self, name)
            if number is not None and number < 1:
                raise UserError(f"`{name}` is {number}: it must be 1 or more")
        self._check_levels()
        if self.in_flight is not None and self.batch is not None:
            raise UserError("`in_flight` and `batch` cannot be combined: choose one of them")
        if self.against is not None:
            self._check_against(self.against)
        if not self.may_vary:  # a case fails in all of its runs or in none
            object.__setattr__(self, "tolerated", 0.0)

    def _check_levels(self) -> None:
        if not self.levels or len(set(self.levels)) < len(self.levels):
            raise UserError(f"the levels are {list(self.levels)}: choose at least one, each once")
        if OWN in self.levels and self.pov is None:
            raise UserError("level own needs your own POV: name it with `pov`")

    def _check_against(self, against: str) -> None:
        for name in ("in_flight", "repeat", "tolerated"):
            if name in non_defaults(self, Search):
                raise UserError(f"`{name}` and `against` cannot be combined: remove one of them")
        if waits_for_client(against):
            raise UserError(
                f"`against` is {against}: a client that you start yourself drives one VUT only; "
                "choose an earlier version that merge-sumo starts"
            )
        if against == self.vut:
            raise UserError(f"`against` and `vut` are both {against}: name two different versions")

    @property
    def earlier(self) -> CampaignSettings:
        """The settings of the version that this campaign is against, with the same cases.

        Raises `UserError` where the campaign is against none.
        """
        if self.against is None:
            raise UserError("the campaign has no earlier version (`against`)")
        return replace(self, vut=self.against, against=None)

    def new_sampler(self, predictor: Predictor | None = None) -> Sampler:
        """Return the sampler, without outcomes.

        Args:
            predictor: as of `make_sampler`.
        """
        sampler = make_sampler(self.sampler, self.pool, self.seed, predictor)
        sampler.tolerated = self.tolerated
        return sampler

    @property
    def may_vary(self) -> bool:
        """Whether runs of a case may differ: not where the package brings all that drives."""
        own_pov = OWN in self.levels and self.pov is not None and not is_built_in(self.pov)
        return own_pov or self.scenario.sense.is_random or not is_built_in(self.vut)

    @property
    def criterion(self) -> Criterion:
        """What counts as a failure."""
        return Criterion(self.fail_when, self.require)

    def _controller_options(self, policies: Path | None) -> ControllerOptions:
        """Return how controllers are hosted, with the learned drivers of a folder."""
        return ControllerOptions(
            deadline_s=self.deadline_s,
            memory_gib=self.vut_memory_gib,
            policies=policies,
        )

    @property
    def pool(self) -> Pool:
        """The cases to choose from."""
        return Pool(levels=self.levels, scenario=self.scenario)

    def load_plan(self, *, debug: bool = False) -> SimulationPlan:
        """Read all files that the settings name, and return the plan of the simulation.

        Args:
            debug: whether a controller of the user's runs in this process, without a deadline.

        Raises:
            UserError: drivers, policies or a road are missing or cannot be loaded.
        """
        policies = policies_folder(self.policies, self.scenario)
        options = self._controller_options(policies)
        if debug:
            options = replace(options, in_process=True, deadline_s=DEBUG_DEADLINE_S)
        vut = load(self.vut, options)
        own = None if self.pov is None else own_pov(self.pov, options)
        povs = Povs(policies=policies, own=own)
        for level in self.levels:
            check_level(level, povs.levels, policies)
        return SimulationPlan(
            scenario=self.scenario,
            road=road_for(self.scenario),
            vut=vut,
            against=None if self.against is None else load(self.against, options),
            povs=povs,
            criterion=self.criterion,
        )

    def to_record(self, plan: SimulationPlan) -> dict[str, Any]:
        """Return the content of `campaign.json`: everything that decides the outcomes.

        Args:
            plan: the plan of these settings, for versions and hashes.
        """
        folder = None if self.policies is None else policies_name(plan.povs.policies)
        return {
            **to_plain(self),
            "scenario": self.scenario.to_record(),
            "policies": folder,
            "versions": dict(plan.versions),
            "vut_files": plan.vut.files or None,
            "pov_files": plan.povs.files or None,
            "net_sha256": plan.road.sha256,
            "policies_sha256": dict(plan.policies_sha256),
        }


def same_pov(a: Mapping[str, Any], b: Mapping[str, Any], level: int) -> bool:
    """Return whether two campaigns had the same POV at a level.

    Args:
        a: content of `campaign.json` of a campaign.
        b: content of `campaign.json` of the other; a file that only one of them recorded decides
            nothing.
        level: the level.
    """
    if level == OWN and a.get("pov") != b.get("pov"):
        return False
    name = "pov_files" if level == OWN else "policies_sha256"
    files, others = a.get(name), b.get(name)
    if not (isinstance(files, dict) and isinstance(others, dict)):
        return True
    for file in files.keys() & others.keys():
        if files[file] != others[file] and (level == OWN or file == POLICIES.get(level)):
            return False
    return True


def settings_from_folder(
    folder: Path,
    record: Mapping[str, Any],
    overrides: Mapping[str, object] | None = None,
    *,
    resumes: bool = False,
) -> CampaignSettings:
    """Return the settings of a campaign, as its folder records them.

    Args:
        folder: the folder, for messages.
        record: content of its `campaign.json`.
        overrides: settings that replace recorded ones.
        resumes: whether the campaign continues: else it has no earlier version.

    Raises:
        UserError: for a setting that is missing or wrong, and for a controller that is code and not
            among the overrides: a folder that was received runs no code.
    """
    replaced = {**({} if resumes else {"against": None}), **(overrides or {})}
    values = {**record, **replaced}
    for name, spec in controllers(values).items():
        if name not in replaced:
            raise UserError(
                f"{folder} ran with {name} {printable(spec[:NAME_CHARACTERS])}. A run folder "
                f"cannot start code by itself: set `{name}` again"
            )
    if not isinstance(values.get("scenario"), Scenario):
        values["scenario"] = recorded_scenario(values, folder / SETTINGS)
    known = {}
    for field in fields(CampaignSettings):
        if field.name in values:
            known[field.name] = values[field.name]
        elif field.default is MISSING:
            raise UserError(f"{folder / SETTINGS}: {field.name} is missing")
    try:
        return CampaignSettings(**known)
    except RecordError as error:
        raise UserError(f"{folder / SETTINGS}: {error}") from error


def controllers(record: Mapping[str, Any]) -> dict[str, str]:
    """Return the controllers of a record that are code of a user's, by the name of the setting.

    Args:
        record: content of `campaign.json`.
    """
    found = {}
    for name in CONTROLLERS:
        spec = record.get(name)
        if isinstance(spec, str) and names_code(spec):
            found[name] = spec
    return found
