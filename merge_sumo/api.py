"""merge-sumo from Python: run cases and campaigns, and look at them in a notebook.

import merge_sumo as ms

run = ms.campaign("design2", cases=400, seed=1)
run.failures        # rows for pandas.DataFrame(run.failures); a table in a notebook
run.report()        # path of the HTML report

A VUT is a spec, as after `--vut`, or a class, a function, or an object with `act` or `act_batch`.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from merge_sumo.campaigns.conductor import OnCase, run_campaign
from merge_sumo.campaigns.ground import road_for
from merge_sumo.campaigns.plan import plan_of, resolve
from merge_sumo.campaigns.settings import (
    DEFAULT_CASES,
    CampaignSettings,
    one_level,
    parse_levels,
    povs_of,
)
from merge_sumo.campaigns.single import DEBUG_DEADLINE_S, FIELDS, run_one, settings_and_case
from merge_sumo.campaigns.truth import Truth, ground_truth
from merge_sumo.drivers.vut import vut_factory
from merge_sumo.drivers.vuts.base import VutOptions
from merge_sumo.drivers.vuts.here import AnyVut, drivers_of, is_here
from merge_sumo.errors import UserError
from merge_sumo.recorded import (
    compare_runs,
    concluded,
    export,
    going_on,
    history,
    open_run,
    rerun,
    resume,
)
from merge_sumo.results import CampaignRun, CaseRun
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.scenarios.scenario_file import named_scenario
from merge_sumo.sumo.replay_folder import write_scenario
from merge_sumo.system.folders import check_new, dated
from merge_sumo.system.workers import open_workers
from merge_sumo.values.criterion import PAPER_CRITERION, Criterion
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, US23, Scenario, level_name

__all__ = ["CampaignRun", "CaseRun", "campaign", "compare_runs", "export", "history", "open_run"]
__all__ += ["rerun", "resume", "run_case", "truth"]


def campaign(
    vut: AnyVut,
    *,
    level: int | str = "all",
    sampler: str = DEFAULT_SAMPLER,
    cases: int = DEFAULT_CASES,
    batch: int | None = None,
    seed: int = 0,
    v_vut0_mps: float | None = None,
    vut_command: str | None = None,
    deadline_s: float = DEADLINE_S,
    vut_memory_gib: float = MEMORY_GIB,
    in_process: bool = False,
    stop_after_converged: float | None = None,
    workers: int = 1,
    out: Path | str | None = None,
    net: Path | str | None = None,
    scenario: Scenario | Path | str = US23,
    policies: Path | str | None = None,
    pov: AnyVut | None = None,
    fail_when: str = PAPER_CRITERION.fail_when,
    require: str | None = None,
    learn_from: Sequence[Path | str] = (),
    on_case: OnCase | None = None,
    progress: bool | None = None,
) -> CampaignRun:
    """Test a VUT and return the campaign; the same as `merge-sumo campaign`.

    Args:
        vut: vehicle under test. What can be imported from a module drives as on the command line;
            anything else drives in this process, or in worker processes where they can have a copy.
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all".
        sampler: who chooses the cases.
        cases: number of cases.
        batch: cases per batch; when left out, as many as the sampler wants: few, later more, for
            `coverage`, 40 for the others.
        seed: same seed, same outcomes.
        v_vut0_mps: initial speed of the VUT; the scenario's when left out.
        vut_command: command that starts the controller of `vut="traci"`.
        deadline_s: time that a VUT may take for a step before it is a VUT_ERROR.
        vut_memory_gib: memory that the process of a VUT of your own may take.
        in_process: run such a VUT in this process, where a debugger reaches it.
        stop_after_converged: stop early when less than this share of new coverage is expected.
        workers: processes that run cases; the outcomes are the same.
        out: new folder to write; `runs/<vut>-<date>` when left out.
        net: SUMO net to use instead of the scenario's.
        scenario: a scenario, its name, or its TOML file.
        policies: folder of learned drivers in the place of the shipped ones.
        pov: a POV of your own: what a `vut` can be.
        fail_when: what counts as a failure, as after `--fail-when`.
        require: what is to hold over time instead, as after `--require`.
        learn_from: folders of earlier campaigns to learn the VUT from.
        on_case: told of every case as it ends.
        progress: show how far it is; by default in a notebook and on a terminal.

    One that is interrupted goes on with `resume`. Raises `UserError` for values that make no
    campaign, or when the folder exists.
    """
    where = _scenario(scenario)
    spec, pov_spec, workers = drivers_of(vut, pov, workers)
    options = VutOptions(deadline_s=deadline_s, memory_gib=vut_memory_gib, in_process=in_process)
    settings = CampaignSettings(
        vut=spec,
        levels=parse_levels(str(level), povs_of(policies, where, pov_spec, options)),
        sampler=sampler,
        cases=cases,
        batch=batch,
        seed=seed,
        v_vut0_mps=v_vut0_mps,
        stop_after_converged=stop_after_converged,
        vut_command=vut_command,
        deadline_s=deadline_s,
        vut_memory_gib=vut_memory_gib,
        in_process=in_process,
        policies=None if policies is None else str(policies),
        pov=pov_spec,
        learn_from=tuple(map(str, learn_from)),
        scenario=where,
        fail_when=fail_when,
        require=require,
    )
    folder = dated(spec) if out is None else Path(out)
    road = road_for(settings.scenario, None if net is None else Path(net))
    with going_on(settings, folder, workers, on_case, progress) as (there, panel, told):
        done = run_campaign(settings, folder, road, told, workers=there)
        return concluded(done, settings, road, there, panel)


def run_case(
    vut: AnyVut,
    case: Mapping[str, Any] | None = None,
    *,
    level: int | str | None = None,
    scenario: Scenario | Path | str = US23,
    policies: Path | str | None = None,
    pov: AnyVut | None = None,
    net: Path | str | None = None,
    vut_command: str | None = None,
    deadline_s: float = DEADLINE_S,
    vut_memory_gib: float = MEMORY_GIB,
    debug: bool = False,
    gui: bool = False,
    out: Path | str | None = None,
    **coordinates: float,
) -> CaseRun:
    """Run one case and return it; the same as `merge-sumo run`.

    Args:
        vut: as of `campaign`.
        case: a row of `run.cases` or `run.failures`: what is not given is as there.
        level: POV level 0, 1 or 2, or "own" for a `pov`; 0 when it stands nowhere.
        scenario: a scenario, its name, or its TOML file.
        policies: folder of learned drivers in the place of the shipped ones.
        pov: a POV of your own: what a `vut` can be.
        net: SUMO net to use instead of the scenario's.
        vut_command: command that starts the controller of `vut="traci"`.
        deadline_s: time that a VUT may take for a step before it is a VUT_ERROR.
        vut_memory_gib: memory that the process of a VUT of your own may take.
        debug: run the VUT in this process without a deadline, so that breakpoints work.
        gui: show it in sumo-gui while it runs; returns when the window is closed.
        out: new folder to keep it in.
        coordinates: `x_pov0_m`, `v_pov0_mps`, at level 2 `svo_rad`, and what else the scenario has:
            `v_vut0_mps`, `headway_ahead_s`, `headway_behind_s`.

    Raises `UserError` for values that make no case, or when the folder exists.
    """
    unknown = coordinates.keys() - FIELDS.keys()
    if unknown:
        raise UserError(f"a case has no {min(unknown)}: it has {', '.join(FIELDS)}")
    where = _scenario(scenario)
    spec, pov_spec, _ = drivers_of(vut, pov, 1)
    given = {
        "vut": spec,
        "scenario": where,
        "policies": None if policies is None else str(policies),
        "pov": pov_spec,
        "vut_command": vut_command,
        "deadline_s": DEBUG_DEADLINE_S if debug else deadline_s,
        "vut_memory_gib": vut_memory_gib,
        "in_process": debug,
    }
    row = dict(case or {})
    recorded = level_name(int(row.get("level", 0)))
    povs = povs_of(policies, where, pov_spec)
    known = {name: row[name] for name in FIELDS if row.get(name) is not None}
    wanted = one_level(recorded if level is None else str(level), povs)
    settings, one = settings_and_case(None, wanted, {**known, **coordinates}, given)
    road = road_for(settings.scenario, None if net is None else Path(net))
    if out is not None:
        check_new(Path(out))
    found = run_one(plan_of(settings, road, cases=1), one, live=gui)
    if out is not None:
        write_scenario(Path(out), road, found.outcome, found.trajectory)
    return CaseRun(found)


def truth(
    vut: AnyVut,
    level: int | str,
    *,
    cases: int | None = None,
    seed: int = 0,
    scenario: Scenario | Path | str = US23,
    policies: Path | str | None = None,
    pov: AnyVut | None = None,
    fail_when: str = PAPER_CRITERION.fail_when,
    require: str | None = None,
    vut_command: str | None = None,
    deadline_s: float = DEADLINE_S,
    vut_memory_gib: float = MEMORY_GIB,
    in_process: bool = False,
    workers: int = 1,
) -> Truth:
    """Return the ground truth of a VUT at a level; the same as `merge-sumo truth`.

    It comes from the cache where it is there. That of an object of this process, which a name does
    not tell from another, is never kept. Arguments are as of `campaign`.
    """
    where = _scenario(scenario)
    spec, pov_spec, workers = drivers_of(vut, pov, workers)
    options = VutOptions(deadline_s=deadline_s, memory_gib=vut_memory_gib, in_process=in_process)
    povs = povs_of(policies, where, pov_spec, options)
    own = VutOptions(
        command=vut_command,
        deadline_s=deadline_s,
        memory_gib=vut_memory_gib,
        in_process=in_process,
        policies=povs.policies,
    )
    plan = resolve(
        vut_factory(spec, own),
        scenario=where,
        criterion=Criterion(fail_when, require),
        povs=povs,
    )
    with (
        tempfile.TemporaryDirectory(prefix="merge-sumo-") as forgotten,
        open_workers(povs.workers(plan.vut, workers)) as there,
    ):
        number = one_level(str(level), povs)
        cache = Path(forgotten) if is_here(spec) or is_here(pov_spec or "") else None
        return ground_truth(plan, number, cases, seed, workers=there, cache=cache)


def _scenario(scenario: Scenario | Path | str) -> Scenario:
    return scenario if isinstance(scenario, Scenario) else named_scenario(str(scenario))
