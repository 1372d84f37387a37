"""What Python does with campaigns that were run; `merge_sumo.api` is the way to it."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.avoidance import note_avoidance
from merge_sumo.campaigns.conductor import SCENARIOS, OnCase, resume_campaign
from merge_sumo.campaigns.ground import road_for
from merge_sumo.campaigns.run import Run, read_settings
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.drivers.vuts.here import AnyVut, drivers_of
from merge_sumo.errors import UserError
from merge_sumo.reports import comparison, exports
from merge_sumo.reports.campaign_panel import CampaignPanel, panel_of
from merge_sumo.reports.changes import RunComparison
from merge_sumo.reports.comparison_page import write_comparison
from merge_sumo.reports.history import History, history_of
from merge_sumo.reports.history_page import write_history
from merge_sumo.reports.progress import is_watched
from merge_sumo.reports.report import check_report, write_report
from merge_sumo.reports.rerun import Rerun, settings_today
from merge_sumo.reports.rerun import rerun as run_again
from merge_sumo.results import CampaignRun
from merge_sumo.sumo.corridor import Corridor
from merge_sumo.system.folders import check_new_file, link_latest
from merge_sumo.system.workers import Workers, open_workers
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory

AnyRun = CampaignRun | Path | str
"""A campaign, or its folder."""


def open_run(folder: Path | str) -> CampaignRun:
    """Open the folder of a campaign; `UserError` when it is none."""
    return CampaignRun(folder)


def resume(
    run: AnyRun,
    *,
    vut: AnyVut | None = None,
    pov: AnyVut | None = None,
    cases: int | None = None,
    workers: int = 1,
    net: Path | str | None = None,
    force: bool = False,
    trust_vut: bool = False,
    on_case: OnCase | None = None,
    progress: bool | None = None,
) -> CampaignRun:
    """Go on with a campaign that was stopped; the same as `merge-sumo campaign --resume`.

    Args:
        run: the campaign, or its folder.
        vut: the campaign's when left out. An object of a process that is gone is to be given again,
            and nothing but its name tells that it is the same.
        pov: as `vut`, where the campaign had one.
        cases: how many in all, where there are to be more than it had.
        workers: processes that run cases; the outcomes are the same.
        net: net for that; must be the one of the campaign.
        force: go on although something differs that decides outcomes.
        trust_vut: run the controller that a folder names although it was not made here.
        on_case: told of every case as it ends.
        progress: show how far it is; by default in a notebook and on a terminal.

    Raises `UserError` as the command says.
    """
    folder = run.folder if isinstance(run, CampaignRun) else Path(run)
    recorded = read_settings(folder)
    spec, pov_spec, workers = drivers_of(
        str(recorded.get("vut")) if vut is None else vut,
        recorded.get("pov") if pov is None else pov,
        workers,
    )
    named = {"vut": vut and spec, "pov": pov and pov_spec, "cases": cases}
    given = {name: value for name, value in named.items() if value is not None}
    settings = settings_of(folder, recorded, given, trust=trust_vut)
    check_report(folder)
    road = road_for(settings.scenario, None if net is None else Path(net))
    with going_on(settings, folder, workers, on_case, progress) as (there, panel, told):
        done = resume_campaign(
            folder,
            road,
            told,
            on_before=panel.ran_before,
            given=given,
            force=force,
            workers=there,
            warn=warnings.warn,
            trust=trust_vut,
        )
        return concluded(done, settings, road, there, panel)


@contextmanager
def going_on(
    settings: CampaignSettings,
    folder: Path,
    workers: int,
    on_case: OnCase | None,
    progress: bool | None,
) -> Iterator[tuple[Workers, CampaignPanel, OnCase]]:
    """Give workers, what shows how far a campaign is, and what is to be told of its cases.

    Of a campaign that is interrupted it is noted how to go on.
    """
    title = f"{settings.vut} v level {'/'.join(map(level_name, settings.levels))}"
    quiet = not (is_watched() if progress is None else progress)
    try:
        with (
            open_workers(settings.workers(workers)) as there,
            panel_of(
                title,
                settings.cases,
                settings.levels,
                folder,
                workers=there.count,
                quiet=quiet,
            ) as panel,
        ):

            def told(outcome: Outcome) -> None:
                panel.case_ended(outcome)
                if on_case is not None:
                    on_case(outcome)

            yield there, panel, told
    except KeyboardInterrupt as stop:
        if folder.exists():
            link_latest(folder)
            stop.add_note(f"stopped; go on with ms.resume({str(folder)!r})")
        raise


def concluded(
    done: Run, settings: CampaignSettings, road: Corridor, workers: Workers, panel: CampaignPanel
) -> CampaignRun:
    """Return a campaign that has ended, with what is found out of it behind its end."""
    note_avoidance(done, settings, road, workers=workers, on_part=panel.driven_again)
    link_latest(done.folder)
    run = CampaignRun(done.folder)
    write_report(run.run, run.summary, workers, panel.report_part)
    return run


def rerun(
    run: AnyRun,
    indices: Iterable[int] | int = (),
    *,
    vut: AnyVut | None = None,
    workers: int = 1,
    net: Path | str | None = None,
    trust_vut: bool = False,
    **settings: Any,
) -> Rerun:
    """Run recorded cases again with a changed VUT; the same as `merge-sumo rerun`.

    Args:
        run: the campaign, or its folder.
        indices: its cases; all of them when left out.
        vut: as of `campaign`; the campaign's, as its files are now, when left out.
        workers: processes that run cases.
        net: net for that; must be the one of the campaign.
        trust_vut: run the controller that a folder names although it was not made here.
        settings: others to change: `vut_command`, `deadline_s`, `vut_memory_gib`, `in_process`,
            `policies`.

    Raises `UserError` as the command says.
    """
    opened = _opened(run)
    if vut is not None:
        settings["vut"], _, workers = drivers_of(vut, None, workers)
    today = settings_today(opened.run, settings, trust=trust_vut)
    with open_workers(today.workers(workers)) as there:
        where = None if net is None else Path(net)
        return run_again(opened.run, today, _listed(indices), net=where, workers=there)


def compare_runs(
    a: AnyRun,
    b: AnyRun,
    *,
    rerun: bool = True,
    net: Path | str | None = None,
    policies: Path | str | None = None,
    trust_vut: bool = False,
    out: Path | str | None = None,
    tolerance: float = 0.0,
) -> RunComparison:
    """Compare two campaigns: what got fixed, and what broke; as `merge-sumo compare-runs`.

    `worse(tolerance)` of what is returned says why B is worse, if it is.

    Args:
        a: the campaign before, or its folder.
        b: the campaign after, or its folder.
        rerun: run the failures, errors and timeouts of each with the other's VUT.
        net: net for that; must be the one of the campaigns.
        policies: folder of the learned drivers, where they are elsewhere now.
        trust_vut: run the controllers that the folders name although they were not made here.
        out: page to write; nothing may be there. None is written when left out.
        tolerance: by how much B may be worse before the page says so.
    """
    if out is not None:
        check_new_file(Path(out))
    first, second = _opened(a).run, _opened(b).run
    given = {} if policies is None else {"policies": str(policies)}
    road = road_for(first.scenario, None if net is None else Path(net)) if rerun else None
    motions: dict[tuple[str, int], Trajectory] = {}

    def keep(of: str, index: int, trajectory: Trajectory) -> None:
        motions[of, index] = trajectory

    compared = comparison.compare_runs(
        first, second, rerun=rerun, net=road, given=given, trust=trust_vut, on_again=keep
    )
    if out is not None:
        write_comparison(compared, first, second, motions, tolerance, Path(out))
    return compared


def history(runs: Iterable[AnyRun], *, out: Path | str | None = None) -> History:
    """Return what became of a VUT over several campaigns; the same as `merge-sumo history`.

    Everything is read from the records: no case runs again, and no VUT. `print` and a notebook show
    it in lines, `to_record()` returns it as JSON has it.

    Args:
        runs: the campaigns, or their folders, the oldest first.
        out: page to write; nothing may be there. None is written when left out.

    Raises `UserError` for fewer than two campaigns, and where scenario, criterion, initial speed
    of the VUT or POV differ.
    """
    if isinstance(runs, str | Path | CampaignRun):
        raise UserError("give several campaigns in a list, the oldest first")
    if out is not None:
        check_new_file(Path(out))
    found = history_of([_opened(run).run for run in runs])
    if out is not None:
        write_history(found, Path(out))
    return found


def _listed(indices: Iterable[int] | int) -> tuple[int, ...]:
    return tuple(indices) if isinstance(indices, Iterable) else (int(indices),)


EXPORTS: Final = "exports"


def export(
    run: AnyRun,
    indices: Iterable[int] | int | None = None,
    *,
    file_format: str = "sumo",
    out: Path | str | None = None,
    net: Path | str | None = None,
) -> list[Path]:
    """Write cases of a campaign for others, and return the paths; as `merge-sumo export`.

    Args:
        run: the campaign, or its folder.
        indices: its cases; of a table all of them when left out.
        file_format: "sumo" or "openscenario" for folders, "csv" or "parquet" for one table.
        out: folder; `scenarios` or `exports` in that of the campaign when left out.
        net: SUMO net to use instead of the scenario's.
    """
    loaded = _opened(run).run
    wanted = None if indices is None else list(_listed(indices))
    if file_format in ("csv", "parquet"):
        wanted = wanted or [outcome.index for outcome in loaded.outcomes]
        folder = Path(out) if out is not None else loaded.folder / EXPORTS
        return [exports.write_table(loaded, wanted, folder, file_format)]
    writers = {"sumo": exports.write_sumo, "openscenario": exports.write_openscenario}
    if file_format not in writers:
        raise UserError(f"there is no format {file_format!r}: sumo, openscenario, csv or parquet")
    if not wanted:
        raise UserError(f"the format {file_format} needs the indices of cases")
    below = SCENARIOS if file_format == "sumo" else EXPORTS
    target = Path(out) if out is not None else loaded.folder / below
    road = road_for(loaded.scenario, None if net is None else Path(net))
    return list(exports.write_folders(loaded, wanted, target, writers[file_format], road))


def _opened(run: AnyRun) -> CampaignRun:
    return run if isinstance(run, CampaignRun) else CampaignRun(run)
