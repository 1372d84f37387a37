"""The conductor: a sampler proposes, the world runs, the journal remembers."""

from __future__ import annotations

import os
import platform
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, field, fields
from functools import partial
from importlib.metadata import version
from pathlib import Path
from threading import RLock
from typing import Any, Final, Self, get_args, get_origin, get_type_hints

import numpy as np

from merge_sumo.case import Case, Pool
from merge_sumo.convergence import StoppingRule
from merge_sumo.drivers.policies import read_manifest
from merge_sumo.drivers.pov import PovLibrary, available_levels
from merge_sumo.drivers.vut import VutFactory, runs_code, vut_factory
from merge_sumo.drivers.vuts.base import VutOptions
from merge_sumo.drivers.vuts.files import Files, hashed, sha256_of
from merge_sumo.drivers.vuts.output import LOG
from merge_sumo.errors import UserError
from merge_sumo.folders import check_new, check_own
from merge_sumo.journal import SETTINGS, Journal, Run, failures, scenario_of
from merge_sumo.rollout import rollout
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario import DEADLINE_S, LEVELS, MEMORY_GIB, US23, Scenario
from merge_sumo.score import Measures, Outcome, measure
from merge_sumo.sumo.corridor import Corridor
from merge_sumo.sumo.net import Net
from merge_sumo.sumo.replay import write_scenario
from merge_sumo.sumo.road import corridor_of, road_of
from merge_sumo.sumo.world import World
from merge_sumo.trajectory import End, Trajectory
from merge_sumo.trust import SEAL, is_own, seal
from merge_sumo.workers import MAX_DEATHS, Workers, open_workers, when_worker_ends

DEFAULT_CASES: Final = 800
DEFAULT_BATCH: Final = 40
MAX_CORRIDORS: Final = 32
EXPORTED_FAILURES: Final = 10
SCENARIOS: Final = "scenarios"
FORCED: Final = "forced"
"""Key of `campaign.json`: what differed where a campaign went on with --force."""

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
    v_vut0_mps: float | None = None
    stop_after_converged: float | None = None
    vut_command: str | None = None
    deadline_s: float = DEADLINE_S
    vut_memory_gib: float = MEMORY_GIB
    in_process: bool = False
    scenario: Scenario = US23

    def __post_init__(self) -> None:
        """Check the numbers, the names and the levels; the scenario says what is left out."""
        if self.v_vut0_mps is None:
            object.__setattr__(self, "v_vut0_mps", self.scenario.v_vut0_mps)
        for option, text in (("--vut", self.vut), ("--vut-command", self.vut_command or "")):
            if not _is_text(text):
                raise UserError(
                    f"{option} is {text!r}, which campaign.json cannot record: it is not UTF-8; "
                    "rename the file"
                )
        _ = self.vut_factory
        if not self.levels or len(set(self.levels)) < len(self.levels):
            raise UserError(f"the levels are {list(self.levels)}: name each level once")
        for level in self.levels:
            check_level(level)
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
        most_mps = self.scenario.v_start_max_mps
        if not 0.0 <= self.pool.v_vut0_mps <= most_mps:
            raise UserError(f"--v-vut0 is {self.v_vut0_mps}: choose between 0 and {most_mps:g} m/s")
        self.stopping_rule()

    def stopping_rule(self) -> Callable[[Sequence[Outcome]], bool]:
        """Return what says of the outcomes so far whether the search is over."""
        if self.stop_after_converged is None:
            return lambda _: False
        fresh = partial(make_sampler, self.sampler, self.pool, self.seed)
        return StoppingRule(self.stop_after_converged, self.batch, fresh)

    @property
    def vut_factory(self) -> VutFactory:
        """What makes the VUT."""
        options = VutOptions(
            command=self.vut_command,
            deadline_s=self.deadline_s,
            memory_gib=self.vut_memory_gib,
            in_process=self.in_process,
        )
        return vut_factory(self.vut, options)

    @property
    def pool(self) -> Pool:
        """The cases to choose from."""
        assert self.v_vut0_mps is not None, "taken from the scenario"  # noqa: S101
        return Pool(levels=self.levels, v_vut0_mps=self.v_vut0_mps, scenario=self.scenario)


_DEFAULTS: Final = {
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


def parse_levels(text: str) -> tuple[int, ...]:
    """Return the levels that `--level` names: one, or all for which there is a policy."""
    if text == "all":
        return available_levels()
    if text not in map(str, LEVELS):
        raise UserError(f"there is no POV level {text!r}: choose 0, 1, 2 or all")
    check_level(int(text))
    return (int(text),)


def check_level(level: int) -> None:
    """Raise `UserError` when there is no POV of a level."""
    if level not in LEVELS:
        raise UserError(f"there is no POV level {level}: choose 0, 1, 2 or all")
    if level not in available_levels():
        raise UserError(
            f"there is no policy for a POV of level {level}: run `merge-sumo train` to make it"
        )


def one_level(text: str) -> int:
    """Return the one level that `--level` names."""
    if text == "all":
        raise UserError("--level all does not go here: choose 0, 1 or 2")
    return parse_levels(text)[0]


def versions() -> dict[str, str]:
    """Return the versions that decide the outcome of a case."""
    packages = ("merge-sumo", "libsumo", "numpy", "scipy", "scikit-learn")
    return {"python": platform.python_version()} | {name: version(name) for name in packages}


def software() -> dict[str, str]:
    """Return the versions, and the hashes of the policies, by name."""
    policies = {f"policy {name}": entry["sha256"] for name, entry in read_manifest().items()}
    return versions() | policies


class ProvingGround:
    """A VUT and the POV library in a SUMO world: takes cases, gives trajectories."""

    def __init__(
        self,
        vut: str | VutFactory,
        corridors: int = MAX_CORRIDORS,
        net: Net | Corridor | None = None,
    ) -> None:
        """Start SUMO and the VUT, with fewer corridors where the VUT cannot serve as many."""
        factory = vut if isinstance(vut, VutFactory) else vut_factory(vut)
        corridors = min(corridors, factory.vut.max_corridors or corridors)
        self.world = World(corridors, net, factory.vut.vut_type)
        try:
            self.vut = factory(corridors, self.world)
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


@dataclass(frozen=True, kw_only=True, slots=True)
class GroundPlan:
    """What it takes to open a `ProvingGround` in any process; it travels with every chunk."""

    vut: VutFactory
    corridors: int
    net: Net | Corridor
    software: dict[str, str] = field(default_factory=software)

    def key(self) -> tuple[object, ...]:
        """Return what tells one plan from another."""
        vut = self.vut.spec, self.vut.options, self.vut.files
        road = corridor_of(self.net)
        edges = road.sha256, road.mainline_edges, road.ramp_edges
        return *vut, self.corridors, *edges, *self.software.items()

    def open(self) -> ProvingGround:
        """Open the proving ground; `UserError` where other software would give other outcomes."""
        for name, (there, here) in differences(self.software, software()).items():
            raise UserError(
                f"a worker has {name} {here}, and this process {there}: install the same there"
            )
        return ProvingGround(self.vut, self.corridors, self.net)


@dataclass(frozen=True, slots=True)
class Ran:
    """What became of one case, and the files that had decided on the VUT's answers by then."""

    measures: Measures
    trajectory: Trajectory
    files: Files = field(default_factory=dict)


_kept: tuple[tuple[object, ...], ProvingGround] | None = None
"""The proving ground of this process, with the key of its plan: it stays open between chunks."""
_one_at_a_time = RLock()
"""libsumo holds one simulation per process, and some clusters give a process several threads."""


def run_cases(plan: GroundPlan, cases: Sequence[Case]) -> list[Ran]:
    """Run cases on the proving ground of this process and return what became of each."""
    with _one_at_a_time:
        ground = _ground(plan)
        try:
            ran = dict(ground.run(cases))
            files = hashed(ground.vut.files())
        except BaseException:
            _close_ground()  # it stands in the middle of episodes
            raise
    return [Ran(measure(ran[place]), ran[place], files) for place in range(len(cases))]


def _ground(plan: GroundPlan) -> ProvingGround:
    global _kept  # noqa: PLW0603 (one SUMO per process)
    if _kept is None or _kept[0] != plan.key():
        _close_ground()
        _kept = plan.key(), plan.open()
        when_worker_ends(_close_ground)
    return _kept[1]


def _close_ground() -> None:
    global _kept
    with _one_at_a_time:
        if _kept is not None:
            ground, _kept = _kept[1], None
            ground.__exit__(None, None, None)


def lost_case(case: Case) -> Ran:
    """Return what is recorded of a case that ended every worker that ran it."""
    x_vut0_m = case.scenario.x_vut0_m
    start = [[case.x_pov0_m, case.v_pov0_mps, 0.0, x_vut0_m, case.v_vut0_mps, 0.0]]
    reason = f"its worker process died {MAX_DEATHS} times"
    trajectory = Trajectory(case, np.array(start), End.SIM_ERROR, reason)
    return Ran(measure(trajectory), trajectory)


RunCases = Callable[[Sequence[Case]], Iterable[tuple[int, Ran]]]
"""Runs cases somewhere; gives (place, what became of the case) in any order."""


def runs_on(workers: Workers, plan: GroundPlan) -> RunCases:
    """Return what runs cases on workers; `UserError` when the plan cannot be carried out there."""

    def died(_: None) -> None:
        raise UserError(f"opening the VUT {plan.vut.spec} ended its process: look into the VUT")

    for _ in workers.run(partial(_open_ground, plan), [None], died):
        pass
    return lambda cases: workers.run(partial(run_cases, plan), cases, lost_case)


def _open_ground(plan: GroundPlan, nothing: Sequence[None]) -> Sequence[None]:
    with _one_at_a_time:
        _ground(plan)
    return nothing


def conduct(
    sampler: Sampler,
    run: RunCases,
    cases: int,
    batch: int,
    on_case: OnCase | None = None,
    history: Sequence[Outcome] = (),
    stop: Callable[[Sequence[Outcome]], bool] = lambda _: False,
) -> Iterator[list[tuple[Outcome, Trajectory]]]:
    """Ask, run, tell, batch by batch; yield what each batch gave, in order of the cases.

    It ends after `cases`, or earlier where `stop` says so of the outcomes so far. A campaign goes
    on after `history`, whole batches of its own outcomes: the sampler is told them, and as it is
    pure in what it was told, it proposes what it would have proposed then.
    """
    sampler.tell(history)
    batches_before = history[-1].batch + 1 if history else 0
    for number, first in enumerate(range(len(history), cases, batch), start=batches_before):
        if stop(sampler.told()):
            return
        ran: list[tuple[Outcome, Trajectory]] = []
        for place, done in run(sampler.ask(min(batch, cases - first))):
            outcome = Outcome(first + place, number, done.trajectory.case, done.measures)
            ran.append((outcome, done.trajectory))
            if on_case is not None:
                on_case(outcome)
        ran.sort(key=lambda pair: pair[0].index)
        sampler.tell(outcome for outcome, _ in ran)
        yield ran


def run_campaign(
    settings: CampaignSettings,
    folder: Path,
    net: Net | Corridor | None = None,
    on_case: OnCase | None = None,
    *,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
) -> Run:
    """Run a campaign into a new folder and return it as read back from there.

    Same settings, same versions: same `outcomes.jsonl`, whatever the workers. The worst failures
    are exported as folders that sumo-gui opens. Raises `UserError` when the folder exists.

    Args:
        settings: what to run.
        folder: where to.
        net: the road, by default the shipped one.
        on_case: told of every case.
        workers: where cases run, by default in this process.
        check: called after every batch; may raise to stop there, and `resume_campaign` goes on.
    """
    check_new(folder)
    check_new(folder / SCENARIOS / case_name(settings.cases))
    net = net or road_for(settings.scenario)
    with workers_or_here(workers) as there:
        run = runs_on(there, _plan(settings, net, folder))
        record = record_of(settings, net)
        sealed = {**record, SEAL: seal(record)}
        with Journal.create(folder, sealed) as journal:
            return _go_on(settings, sealed, net, journal, run, (), on_case, check)


def resume_campaign(
    folder: Path,
    net: Net | Corridor | None = None,
    on_case: OnCase | None = None,
    *,
    given: Mapping[str, object] | None = None,
    force: bool = False,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
    warn: Callable[[str], None] = lambda _: None,
    trust: bool = False,
) -> Run:
    """Go on with a campaign that was stopped, however it was; return it as `run_campaign` does.

    The result is the same to the last byte as if it had never been stopped. Raises `UserError`
    with the name of the field where something differs that decides outcomes: settings that are
    `given`, versions, net, policies. With `force` it goes on and records that they did.

    Args:
        folder: where the campaign is.
        net: the net with which it was started, by default the shipped one.
        on_case: told of every case, also of those that ran before.
        given: settings that a person named again, by their names in `CampaignSettings`.
        force: go on although something differs.
        workers: where cases run, by default in this process.
        check: called after every batch; may raise to stop there.
        warn: told in a sentence what was dropped.
        trust: run the controller that the folder names although the folder may be a stranger's.
    """
    check_own(folder / SCENARIOS)
    journal, before, dropped = Journal.reopen(folder)
    net = net or road_for(before.scenario)
    with journal, workers_or_here(workers) as there:
        recorded = {k: v for k, v in before.settings.items() if k not in (FORCED, SEAL)}
        settings = settings_of(folder, before.settings, given, trust=trust)
        record = record_of(settings, net)
        # What was loaded while it ran must be the same, too, although it is not loaded yet.
        record["vut_files"] = _files_again(recorded) | (record["vut_files"] or {}) or None
        changes = differences(_DEFAULTS | recorded, record)
        if changes and not force:
            name, (was, now) = next(iter(changes.items()))
            raise UserError(
                f"{name} differs: {folder} was run with {was}, now it is {now}; make it the same, "
                "or go on with --force, which is recorded"
            )
        if dropped:
            warn(f"{folder}: dropped {dropped} outcomes of a batch that was stopped; it runs again")
        run = runs_on(there, _plan(settings, net, folder))
        record[SEAL] = seal(record)
        if before.settings.get(FORCED) or changes:
            forced = {"from_case": len(before.outcomes), "differs": changes}
            record[FORCED] = [*_forced(before), *([forced] if changes else [])]
        if changes:
            journal.rewrite_settings(record)
        if on_case is not None:
            for outcome in before.outcomes:
                on_case(outcome)
        return _go_on(settings, record, net, journal, run, before.outcomes, on_case, check)


def _files_again(recorded: Mapping[str, Any]) -> Files:
    """Return the files that a record names, as they are now."""
    files = recorded.get("vut_files")
    try:
        return {name: sha256_of(Path(name)) for name in files} if isinstance(files, dict) else {}
    except ValueError as error:
        raise UserError(f"{SETTINGS} has a file that no file can be named: {error}") from error


def _go_on(
    settings: CampaignSettings,
    record: dict[str, Any],
    net: Net | Corridor,
    journal: Journal,
    run: RunCases,
    history: Sequence[Outcome],
    on_case: OnCase | None,
    check: Callable[[], None],
) -> Run:
    sampler = make_sampler(settings.sampler, settings.pool, settings.seed)
    stop = settings.stopping_rule()
    files: Files = dict(record["vut_files"] or {})

    def noting_files(cases: Sequence[Case]) -> Iterator[tuple[int, Ran]]:
        for place, done in run(cases):
            for name, sha256 in done.files.items():
                files.setdefault(name, sha256)
            yield place, done

    batches = conduct(sampler, noting_files, settings.cases, settings.batch, on_case, history, stop)
    for ran in batches:
        journal.append(ran)
        if len(files) > len(record["vut_files"] or {}):
            record["vut_files"] = dict(files)
            journal.rewrite_settings(record)
        check()
    done = Run(journal.folder)
    for outcome in failures(done.outcomes)[:EXPORTED_FAILURES]:
        folder = journal.folder / SCENARIOS / case_name(outcome.index)
        if not os.path.lexists(folder):  # written whole, before the campaign was stopped
            export_case(done, outcome.index, folder, net)
    return done


def road_for(scenario: Scenario, net: Path | None = None) -> Corridor:
    """Return the road of a scenario, or another net with the same edges.

    Raises `UserError` where there is no such merge, or not room enough for its vehicles.
    """
    file = Path(scenario.net) if net is None and scenario.net is not None else net
    road = road_of(file, scenario.mainline, scenario.ramp, scenario.room_after_m)
    road.check_room(-scenario.x_pov0_m[0], -scenario.x_vut0_m)
    return road


@contextmanager
def workers_or_here(workers: Workers | None) -> Iterator[Workers]:
    """Give the workers, which stay open, or this process as the only one."""
    if workers is not None:
        yield workers
        return
    with open_workers(1) as here:
        yield here


def _plan(settings: CampaignSettings, net: Net | Corridor, folder: Path) -> GroundPlan:
    return GroundPlan(
        vut=settings.vut_factory.with_log(folder.resolve() / LOG),
        corridors=min(MAX_CORRIDORS, settings.batch),
        net=net,
    )


def record_of(settings: CampaignSettings, net: Net | Corridor) -> dict[str, Any]:
    """Return what `campaign.json` holds: everything that decides the outcomes."""
    policies = {name: entry["sha256"] for name, entry in read_manifest().items()}
    return {
        **asdict(settings),
        "versions": versions(),
        "vut_files": settings.vut_factory.files or None,
        "net_sha256": net.sha256,
        "policies_sha256": policies,
    }


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
    vut, command = record.get("vut"), record.get("vut_command")
    named = ("vut" if command is None else "vut_command") in (given or {})
    if not (trust or named or is_own(record)) and runs_code(str(vut), command):
        raise UserError(
            f"{folder} was not made here, and to go on is to run the controller that it names, "
            f"{command or vut}: say --trust-vut if you trust it"
        )
    hints = get_type_hints(CampaignSettings)
    values: dict[str, Any] = {}
    for spec in fields(CampaignSettings):
        value: Any = record.get(spec.name, spec.default)
        if spec.name == "scenario" and isinstance(value, dict):
            value = scenario_of(record, folder / SETTINGS)
        value = tuple(value) if isinstance(value, list) else value
        if not _fits(value, hints[spec.name]):
            raise UserError(f"{folder / SETTINGS} has no {spec.name}, or something else there")
        # 18 is 18.0, and outcomes are to show it as the same number.
        is_real = float in (hints[spec.name], *get_args(hints[spec.name]))
        values[spec.name] = float(value) if is_real and type(value) is int else value
    return CampaignSettings(**values)


def _fits(value: object, hint: Any) -> bool:
    """Return whether a value read from JSON is of the type of a setting."""
    parts = get_args(hint)
    if get_origin(hint) is tuple:
        return isinstance(value, tuple) and all(_fits(item, parts[0]) for item in value)
    if parts:
        return any(_fits(value, part) for part in parts)
    return type(value) is hint or (hint is float and type(value) is int and abs(value) < 2**53)


def differences(was: Any, now: Any, name: str = "") -> dict[str, tuple[Any, Any]]:
    """Return by name where two records differ, with both values; None where there is none."""
    if isinstance(was, dict) and isinstance(now, dict):
        found: dict[str, tuple[Any, Any]] = {}
        for key in now | was:
            inner = f"{name}.{key}" if name else key
            found |= differences(was.get(key), now.get(key), inner)
        return found
    was, now = (list(value) if isinstance(value, tuple) else value for value in (was, now))
    return {} if was == now else {name: (was, now)}


def _forced(run: Run) -> list[Any]:
    forced = run.settings.get(FORCED, [])
    return forced if isinstance(forced, list) else [forced]


def case_name(index: int) -> str:
    """Return the name of a case's folder."""
    return f"case-{index:05d}"


def export_case(run: Run, index: int, folder: Path, net: Net | Corridor | None = None) -> Path:
    """Write a case of a run as a replay folder; return the path of its SUMO configuration."""
    road = net or road_for(run.scenario)
    return write_scenario(folder, road, run.outcome(index), run.trajectory(index))
