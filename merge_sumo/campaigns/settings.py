"""Everything that decides what a campaign does, and how it is written down."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, asdict, dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.ownership import check_own_code
from merge_sumo.campaigns.run import SETTINGS, scenario_of
from merge_sumo.campaigns.stopping import StoppingRule
from merge_sumo.campaigns.transfer import hashes, lessons
from merge_sumo.drivers.policies import how_to_train, policies_in, policies_of
from merge_sumo.engine.povs import POLICIES, Povs, own_pov
from merge_sumo.engine.versions import versions
from merge_sumo.errors import UserError
from merge_sumo.road.corridor import Corridor
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.system.records import RecordError, check_fields, convert
from merge_sumo.values.case import Pool
from merge_sumo.values.criterion import PAPER_CRITERION, Criterion
from merge_sumo.values.scenario import (
    ALL_LEVELS,
    DEADLINE_S,
    MEMORY_GIB,
    OWN,
    US23,
    Scenario,
    level_name,
)
from merge_sumo.values.score import Outcome
from merge_sumo.vuts.base import VutOptions
from merge_sumo.vuts.registry import VutFactory, vut_factory

DEFAULT_CASES: Final = 800


@dataclass(frozen=True, kw_only=True, slots=True)
class CampaignSettings:
    """Everything that decides what a campaign does; `UserError` for values that make none."""

    vut: str
    levels: tuple[int, ...]
    sampler: str = DEFAULT_SAMPLER
    cases: int = DEFAULT_CASES
    batch: int | None = None
    seed: int = 0
    v_vut0_mps: float | None = None
    stop_after_converged: float | None = None
    vut_command: str | None = None
    deadline_s: float = DEADLINE_S
    vut_memory_gib: float = MEMORY_GIB
    in_process: bool = False
    policies: str | None = None
    pov: str | None = None
    learn_from: tuple[str, ...] = ()
    scenario: Scenario = US23
    fail_when: str = PAPER_CRITERION.fail_when
    require: str | None = None

    def __post_init__(self) -> None:
        """Check the numbers, the names and the levels; the scenario says what is left out."""
        check_fields(self)
        if self.policies is not None:
            object.__setattr__(self, "policies", str(policies_in(self.policies)))
        fixed = self.scenario.v_vut0_mps
        if self.v_vut0_mps is None and isinstance(fixed, float):
            object.__setattr__(self, "v_vut0_mps", fixed)
        elif self.v_vut0_mps is not None and not isinstance(fixed, float):
            # Then it is no coordinate of the pool any more.
            narrowed = replace(self.scenario, v_vut0_mps=float(self.v_vut0_mps))
            object.__setattr__(self, "scenario", narrowed)
        for option, text in (
            ("--vut", self.vut),
            ("--vut-command", self.vut_command),
            ("--policies", self.policies),
            ("--pov", self.pov),
            *(("--learn-from", folder) for folder in self.learn_from),
        ):
            if text is not None and not _is_text(text):
                raise UserError(
                    f"{option} is {text!r}, which campaign.json cannot record: it is not UTF-8; "
                    "rename it"
                )
        criterion = self.criterion
        object.__setattr__(self, "fail_when", criterion.fail_when)
        object.__setattr__(self, "require", criterion.require)
        criterion.check(self.scenario)
        _ = self.vut_factory
        if not self.levels or len(set(self.levels)) < len(self.levels):
            raise UserError(f"the levels are {list(self.levels)}: name each level once")
        povs = self.povs
        for level in self.levels:
            check_level(level, povs)
        self._check_sampler()
        for name in ("cases", "batch"):
            if (number := getattr(self, name)) is not None and number < 1:
                raise UserError(f"--{name} is {number}: it must be 1 or more")
        if self.batch is not None and self.batch > self.cases:
            raise UserError(
                f"--batch is {self.batch} and --cases is {self.cases}: a batch cannot have more "
                "cases than the campaign"
            )
        if self.seed < 0:
            raise UserError(f"--seed is {self.seed}: it must be 0 or more")
        most_mps = self.scenario.v_start_max_mps
        if self.v_vut0_mps is not None and not 0.0 <= self.v_vut0_mps <= most_mps:
            raise UserError(f"--v-vut0 is {self.v_vut0_mps}: choose between 0 and {most_mps:g} m/s")
        self.stopping_rule()

    def _check_sampler(self) -> None:
        sampler = make_sampler(self.sampler, self.pool, self.seed)
        if self.learn_from and not sampler.uses_predictions:
            able = [name for name, kind in SAMPLERS.items() if kind.uses_predictions]
            raise UserError(
                f"--learn-from needs a sampler that plays cases out: choose --sampler "
                f"{' or '.join(able)}"
            )

    def stopping_rule(self) -> Callable[[Sequence[Outcome]], bool] | None:
        """Return what says of the outcomes so far whether the search is over, if anything does."""
        if self.stop_after_converged is None:
            return None
        fresh = partial(make_sampler, self.sampler, self.pool, self.seed)
        return StoppingRule(self.stop_after_converged, self.batch, fresh)

    @property
    def vut_factory(self) -> VutFactory:
        """What makes the VUT."""
        return vut_factory(self.vut, self._options)

    @property
    def povs(self) -> Povs:
        """Who drives the POV."""
        return povs_of(self.policies, self.scenario, self.pov, self._options)

    @property
    def criterion(self) -> Criterion:
        """What counts as a failure."""
        return Criterion(self.fail_when, self.require)

    def workers(self, asked: int | None) -> int:
        """Return in how many processes the cases run: see `VutFactory.workers`."""
        return self.povs.workers(self.vut_factory, asked)

    @property
    def _options(self) -> VutOptions:
        return VutOptions(
            command=self.vut_command,
            deadline_s=self.deadline_s,
            memory_gib=self.vut_memory_gib,
            in_process=self.in_process,
            policies=policies_folder(self.policies, self.scenario),
        )

    @property
    def pool(self) -> Pool:
        """The cases to choose from."""
        return Pool(levels=self.levels, v_vut0_mps=self.v_vut0_mps, scenario=self.scenario)


RECORDED_BY_DEFAULT: Final = {
    **{f.name: f.default for f in fields(CampaignSettings) if f.default is not MISSING},
    "v_vut0_mps": US23.v_vut0_mps,
    "scenario": asdict(US23),
}
"""What the settings were in a campaign that does not record them."""


def _is_text(text: str) -> bool:
    """Return whether a text from the command line is one; other bytes come as half characters."""
    try:
        text.encode()
    except UnicodeEncodeError:
        return False
    return True


def policies_folder(policies: str | Path | None, scenario: Scenario) -> Path:
    """Return the folder of the policies that a person names, else of those for a scenario."""
    return policies_of(scenario) if policies is None else policies_in(policies)


def povs_of(
    policies: str | Path | None,
    scenario: Scenario,
    pov: str | None = None,
    options: VutOptions | None = None,
) -> Povs:
    """Return the POVs by the policies and the own POV that a person names, if any.

    One of their own is hosted with the options of the VUT.
    """
    own = None if pov is None else own_pov(pov, options or VutOptions())
    return Povs(policies=policies_folder(policies, scenario), own=own)


CHOICE: Final = "0, 1, 2 or all, or own with --pov"
ONE: Final = "0, 1 or 2, or own with --pov"


def parse_levels(text: str, povs: Povs, choice: str = CHOICE) -> tuple[int, ...]:
    """Return the levels that `--level` names: one, or all for which there is a POV.

    Raises `UserError` for a name of none, and where a POV of a person's own would not drive.
    """
    if text == "all":
        return povs.levels
    by_name = {level_name(level): level for level in ALL_LEVELS}
    if text not in by_name:
        raise UserError(f"there is no POV level {text!r}: choose {choice}")
    level = by_name[text]
    check_level(level, povs)
    if povs.own is not None and level != OWN:
        raise UserError(f"--pov drives at --level own or all, not at --level {text}")
    return (level,)


def check_level(level: int, povs: Povs) -> None:
    """Raise `UserError` when there is no POV of a level."""
    if level not in ALL_LEVELS:
        raise UserError(f"there is no POV level {level}: choose {CHOICE}")
    if level == OWN and povs.own is None:
        raise UserError("--level own is a POV that you bring: name it with --pov")
    if level not in povs.levels:
        raise UserError(
            f"there is no policy for a POV of level {level}{how_to_train(povs.policies)}"
        )


def one_level(text: str, povs: Povs) -> int:
    """Return the one level that `--level` names."""
    if text == "all":
        raise UserError(f"--level all does not go here: choose {ONE}")
    return parse_levels(text, povs, ONE)[0]


def record_of(settings: CampaignSettings, net: Corridor) -> dict[str, Any]:
    """Return what `campaign.json` holds: everything that decides the outcomes."""
    povs = settings.povs
    return {
        **asdict(settings),
        "versions": versions(),
        "vut_files": settings.vut_factory.files or None,
        "pov_files": povs.files or None,
        "net_sha256": net.sha256,
        "policies_sha256": povs.sha256(),
        "learn_from_sha256": hashes(lessons(settings.learn_from, settings.scenario)) or None,
    }


def same_pov(a: Mapping[str, Any], b: Mapping[str, Any], level: int) -> bool:
    """Return whether two campaigns had the same POV at a level, by what both have recorded."""
    name = "pov_files" if level == OWN else "policies_sha256"
    one, other = (known if isinstance(known := r.get(name), dict) else {} for r in (a, b))
    both = one.keys() & other.keys()
    deciding = both if level == OWN else both & {POLICIES.get(level)}
    same_name = level != OWN or a.get("pov") == b.get("pov")
    return same_name and all(one[key] == other[key] for key in deciding)


def settings_of(
    folder: Path,
    recorded: Mapping[str, Any],
    given: Mapping[str, object] | None = None,
    *,
    trust: bool = False,
) -> CampaignSettings:
    """Return the settings of a campaign, as its folder records them or as they are given anew.

    They say whose code is run. Raises `UserError` where one is missing or something else, and where
    the folder may be a stranger's and names a controller that nobody named here, unless we `trust`
    it.
    """
    record = {**recorded, **(given or {})}
    _check_begun_here(folder, record, given or {})
    if not trust:
        check_own_code(folder, recorded, given or {})
    known = {
        spec.name: record[spec.name] for spec in fields(CampaignSettings) if spec.name in record
    }
    if isinstance(known.get("scenario"), dict):
        known["scenario"] = scenario_of(record, folder / SETTINGS)
    if isinstance(known.get("policies"), str) and "policies" not in (given or {}):
        _check_still_there(folder, known["policies"])
    try:
        return convert(known, CampaignSettings)
    except RecordError as error:
        raise UserError(f"{folder / SETTINGS}: {error}") from error


def _check_begun_here(folder: Path, record: Mapping[str, Any], given: Mapping[str, object]) -> None:
    """Raise `UserError` where a controller is to run whose files lie where somebody else stands.

    Their names are relative to where the campaign was begun.
    """
    vut = "vut_command" if record.get("vut_command") else "vut"
    for spec, files in ((vut, "vut_files"), ("pov", "pov_files")):
        who, names = str(record.get(spec)), record.get(files)
        if spec in given or not isinstance(names, dict):
            continue
        beside = [name for name in names if not Path(name).is_absolute()]
        found = any(Path(name).exists() or f"/{name}" in who for name in beside)
        if beside and not found:
            raise UserError(
                f"{folder} was begun where {beside[0]} is, and there is none here: do this in that "
                "folder"
            )


def _check_still_there(folder: Path, policies: str) -> None:
    try:
        policies_in(policies)
    except UserError:
        raise UserError(
            f"{folder} was run with the policies in {policies}, and there are none any more: name "
            "the folder where they are now with --policies"
        ) from None
