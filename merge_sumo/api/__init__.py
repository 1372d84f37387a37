"""merge-sumo from Python: run cases and campaigns, and look at them in a notebook.

import merge_sumo as ms

run = ms.campaign("design2", cases=400, seed=1)
run.failures        # rows for pandas.DataFrame(run.failures); a table in a notebook
run.report()        # path of the HTML report

A VUT is a spec, as after `--vut`, or a class, a function, or an object with `act` or `act_batch`.
Every verb of the command line is a function here, and the command calls that function.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Unpack

from merge_sumo.analysis.coordinates import outside_of_the_pool
from merge_sumo.api.recorded import (
    AnyRun,
    compare_runs,
    export,
    history,
    open_in_gui,
    open_run,
    opened,
    replay,
    report,
    rerun,
)
from merge_sumo.api.results import CampaignRun, CaseRun
from merge_sumo.api.running import Running, concluded, notice_unseen, resume
from merge_sumo.api.setup import (
    CaseKeywords,
    Hosting,
    Settings,
    Setup,
    check_keywords,
    no_check,
    recordable,
    scenario_of,
    settings_for,
)
from merge_sumo.api.studies import certify, check_vut, compare, probability, truth, truths
from merge_sumo.campaigns.campaign import OnCase, run_campaign
from merge_sumo.campaigns.one_case import (
    DEBUG_DEADLINE_S,
    FIELDS,
    Ended,
    run_one,
    settings_and_case,
)
from merge_sumo.campaigns.plan import plan_of
from merge_sumo.campaigns.settings import DEFAULT_CASES, one_level, povs_of
from merge_sumo.drivers.policies import NETWORKS, plays_as, policies_of, read_manifest
from merge_sumo.drivers.policies import scenario_of as policies_scenario
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import Notice, UserError
from merge_sumo.reports.progress import TrainingBars
from merge_sumo.samplers import DEFAULT_SAMPLER
from merge_sumo.sumo.replay_folder import write_scenario
from merge_sumo.system.folders import check_new, dated
from merge_sumo.values.scenario import MEMORY_GIB, US23, Scenario, level_name
from merge_sumo.vuts.base import Car, Seen, VutOptions
from merge_sumo.vuts.in_memory import AnyVut, drivers_of
from merge_sumo.vuts.python import SeenBatch

if TYPE_CHECKING:
    from merge_sumo.campaigns.run import Run
    from merge_sumo.campaigns.settings import CampaignSettings
    from merge_sumo.reports.campaign_panel import CampaignPanel
    from merge_sumo.system.workers import Workers
    from merge_sumo.training.check import PolicyCheck
    from merge_sumo.values.case import Case

__all__ = ["AnyRun", "AnyVut", "CampaignRun", "Car", "CaseKeywords", "CaseRun", "Hosting", "Seen"]
__all__ += ["SeenBatch", "Settings", "Setup", "campaign", "certify", "check_vut", "compare"]
__all__ += ["compare_runs", "export", "history", "open_in_gui", "open_run", "probability"]
__all__ += ["replay", "report", "rerun", "resume", "run_case", "train", "truth", "truths"]


def campaign(
    vut: AnyVut,
    *,
    level: int | str = "all",
    sampler: str = DEFAULT_SAMPLER,
    cases: int = DEFAULT_CASES,
    batch: int | None = None,
    seed: int = 0,
    v_vut0_mps: float | None = None,
    stop_after_converged: float | None = None,
    learn_from: Sequence[Path | str] = (),
    net: Path | str | None = None,
    out: Path | str | None = None,
    workers: int = 1,
    dask: str | None = None,
    on_case: OnCase | None = None,
    check: Callable[[], None] | None = None,
    progress: bool | None = None,
    **setup: Unpack[Setup],
) -> CampaignRun:
    """Test a VUT and return the campaign; the same as `merge-sumo campaign`.

    Args:
        vut: vehicle under test: a spec, a class, a function, or an object.
        level: POV level 0, 1 or 2, "own" for a `pov`, or "all".
        sampler: name of what chooses the cases.
        cases: number of cases.
        batch: cases per batch; by default as many as the sampler wants.
        seed: same seed, same outcomes.
        v_vut0_mps: initial speed of the VUT; the scenario's by default.
        stop_after_converged: stop when less than this share of new coverage is expected.
        learn_from: folders of earlier campaigns to learn the VUT from.
        net: SUMO net to use instead of the scenario's.
        out: new folder to write; `runs/<vut>-<date>` by default.
        workers: processes that run cases; the outcomes are the same.
        dask: address of a Dask scheduler whose workers run the cases instead.
        on_case: called with the outcome of every case as it ends.
        check: called after every batch; may raise to stop there.
        progress: show progress; by default in a notebook and on a terminal.
        setup: how a case is run and judged: `scenario`, `follow_up_s`, `policies`, `pov`,
            `fail_when`, `require`, `vut_command`, `deadline_s`, `vut_memory_gib`, `in_process`;
            see `Setup`.

    An interrupted campaign goes on with `resume`. Raises `UserError` for values that make no
    campaign, or when the folder exists.
    """
    check_keywords("campaign", setup, Setup)
    settings, count = settings_for(
        vut,
        level,
        setup,
        workers=workers,
        sampler=sampler,
        cases=cases,
        batch=batch,
        seed=seed,
        v_vut0_mps=v_vut0_mps,
        stop_after_converged=stop_after_converged,
        learn_from=learn_from,
    )
    folder = dated(settings.vut) if out is None else Path(out)
    road = road_for(settings.scenario, None if net is None else Path(net))
    notice_unseen(settings, setup.get("scenario", US23.name), setup.get("policies"))
    how = Running(
        workers=count, dask=dask, on_case=on_case, check=check or no_check, progress=progress
    )

    def run(there: Workers, _: CampaignPanel, told: OnCase) -> Run:
        return run_campaign(settings, folder, road, told, workers=there, check=how.check)

    return concluded(settings, folder, road, run, how)


def run_case(
    vut: AnyVut | None = None,
    case: Mapping[str, Any] | None = None,
    *,
    recorded: tuple[AnyRun, int] | None = None,
    level: int | str | None = None,
    net: Path | str | None = None,
    debug: bool = False,
    gui: bool = False,
    out: Path | str | None = None,
    trust_vut: bool = False,
    on_end: Callable[[CaseRun], None] | None = None,
    **given: Unpack[CaseKeywords],
) -> CaseRun:
    """Run one case and return it; the same as `merge-sumo run`.

    Args:
        vut: vehicle under test, as of `campaign`; with `recorded`, the campaign's by default.
        case: a row of `run.cases` or `run.failures`: default of level and coordinates.
        recorded: a campaign, or its folder, and the index of its case: default of everything.
        level: POV level 0, 1 or 2, or "own" for a `pov`; by default that of the case, else 0.
        net: SUMO net to use instead of the scenario's.
        debug: run the VUT in this process without a deadline, so that breakpoints work.
        gui: show it in sumo-gui while it runs; returns when the window is closed.
        out: new folder to keep it in.
        trust_vut: run the controller that the folder of `recorded` names although the folder was
            not made here.
        on_end: called with the result when the case has ended, before a window is closed.
        given: coordinates `x_pov0_m`, `v_pov0_mps`, at level 2 `svo_rad`, and others that the
            scenario has: `v_vut0_mps`, `headway_ahead_s`, `headway_behind_s`; and the keywords of
            `Setup`, as of `campaign`.

    Raises `UserError` for values that make no case, or when the folder exists.
    """
    values = {name: value for name, value in given.items() if name in FIELDS}
    setup = {name: value for name, value in given.items() if name not in FIELDS}
    unknown = setup.keys() - Setup.__optional_keys__
    if unknown:
        raise UserError(f"a case has no {min(unknown)}: it has {', '.join(FIELDS)}")
    settings, one = _settings_and_case(vut, case, recorded, level, setup, values, debug, trust_vut)
    if out is not None:
        check_new(Path(out))
    for sentence in outside_of_the_pool(one):
        warnings.warn(sentence, Notice, stacklevel=2)
    road = road_for(settings.scenario, None if net is None else Path(net))

    def ended(found: Ended) -> None:
        if out is not None:
            write_scenario(Path(out), road, found.outcome, found.trajectory)
        if on_end is not None:
            on_end(CaseRun(found))

    return CaseRun(run_one(plan_of(settings, road, cases=1), one, live=gui, on_end=ended))


def _settings_and_case(
    vut: AnyVut | None,
    row: Mapping[str, Any] | None,
    recorded: tuple[AnyRun, int] | None,
    level: int | str | None,
    setup: Mapping[str, Any],
    values: Mapping[str, Any],
    debug: bool,
    trust: bool,
) -> tuple[CampaignSettings, Case]:
    """Return how a case is run, and the case: see `run_case`."""
    if vut is None and recorded is None:
        raise UserError("say with --vut who drives, or with --case which recorded case")
    spec, pov_spec, _ = drivers_of("" if vut is None else vut, setup.get("pov"), 1, stacklevel=4)
    specs = {"vut": vut and spec, "pov": pov_spec}
    given = dict(setup) | {name: value for name, value in specs.items() if value is not None}
    if debug:
        given |= {"in_process": True, "deadline_s": DEBUG_DEADLINE_S}
    if recorded is None:
        given.setdefault("scenario", US23)
    given, policies = recordable(given), setup.get("policies")
    options = VutOptions(memory_gib=setup.get("vut_memory_gib", MEMORY_GIB))
    if recorded is not None:
        run, index = opened(recorded[0]).run, recorded[1]
        number = run.outcome(index).case.level
        if level is not None:
            number = one_level(str(level), povs_of(policies, run.scenario, pov_spec, options))
        return settings_and_case((run, index), number, values, given, trust=trust)
    known = {name: row[name] for name in FIELDS if row.get(name) is not None} if row else {}
    wanted = level_name(int((row or {}).get("level", 0))) if level is None else str(level)
    povs = povs_of(policies, given["scenario"], pov_spec, options)
    return settings_and_case(None, one_level(wanted, povs), {**known, **values}, given)


def train(
    only: Iterable[str] = (),
    *,
    seed: int = 0,
    scenario: Scenario | Path | str | None = None,
    out: Path | str | None = None,
    check: bool = False,
    cases: int = 300,
    progress: bool | None = None,
) -> dict[str, PolicyCheck]:
    """Train the learned drivers in SUMO and return what each loses; as `merge-sumo train`.

    Args:
        only: names of the networks: "pov1", "vut1", "pov2", "vut2"; all by default.
        seed: same seed, same weights on one machine.
        scenario: a `Scenario`, its name, or its TOML file; "us23" by default.
        out: folder; by default that of the shipped policies, for "us23" only.
        check: train nothing, and measure the regret of what the folder has.
        cases: random cases of such a check.
        progress: show progress; by default in a notebook and on a terminal.

    An interrupted training goes on with what is not finished. Raises `UserError` without the extra
    `train`, for a network that does not exist, and for a folder of another scenario.
    """
    played = US23 if scenario is None else scenario_of(scenario)
    folder = Path(out) if out is not None else policies_of(played)
    if out is None and not check and not plays_as(played, US23):
        raise UserError(
            f"the shipped policies are for {US23.name}: say with --out where those for "
            f"{played.name} are to go"
        )
    wanted = set(only) or set(NETWORKS)
    unknown = wanted - set(NETWORKS)
    if unknown:
        raise UserError(f"there is no network {min(unknown)!r}: choose {', '.join(NETWORKS)}")
    names = tuple(name for name in NETWORKS if name in wanted)
    for package in ("torch", "gymnasium"):
        if find_spec(package) is None:
            raise UserError(
                f"training needs {package}, which is not installed: run "
                "`pip install 'merge-sumo[train]'`"
            )
    from merge_sumo.training.check import PolicyCheck, check_policy
    from merge_sumo.training.helix import train_library

    if not check:
        with TrainingBars(shown=progress) as bars:
            train_library(
                folder,
                names,
                seed,
                scenario=played,
                on_progress=bars.progressed,
                on_done=bars.done,
            )
    manifest = read_manifest(folder)
    missing = [name for name in names if name not in manifest]
    if missing:
        raise UserError(f"{folder} has no {missing[0]}: run `merge-sumo train` to make it")
    trained_for = policies_scenario(manifest[names[0]])
    if scenario is None and not plays_as(trained_for, US23):
        raise UserError(
            f"{folder} was trained for {trained_for.name}: say with --scenario in which one to "
            f"check it, or --scenario {US23.name}"
        )
    if check:
        return {n: check_policy(n, folder, count=cases, scenario=played) for n in names}
    return {name: PolicyCheck(**manifest[name]["check"]) for name in names}
