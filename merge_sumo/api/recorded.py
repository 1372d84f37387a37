"""What Python does with campaigns that were run; `merge_sumo.api` is the way to it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Final, Unpack

from merge_sumo.api.results import CampaignRun
from merge_sumo.api.setup import Hosting, check_keywords, recordable
from merge_sumo.campaigns.campaign import SCENARIOS, case_name
from merge_sumo.campaigns.run import SETTINGS, Run
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import UserError
from merge_sumo.reports import exports
from merge_sumo.reports.progress import Counter
from merge_sumo.reports.version_pages import comparison_page, history_page, write_page
from merge_sumo.studies import versions
from merge_sumo.studies.history import History, history_of
from merge_sumo.studies.versions import Rerun, RunComparison, settings_today
from merge_sumo.sumo import replay as replayer
from merge_sumo.sumo.replay import Replay
from merge_sumo.system.folders import check_new_file, check_own
from merge_sumo.system.printable import quoted
from merge_sumo.system.workers import open_workers, workers_or_cores
from merge_sumo.values.scenario import level_name
from merge_sumo.values.trajectory import Trajectory
from merge_sumo.vuts.in_memory import AnyVut, drivers_of

AnyRun = CampaignRun | Path | str
"""A campaign, or its folder."""


def open_run(folder: Path | str) -> CampaignRun:
    """Open the folder of a campaign; `UserError` when it is none."""
    return CampaignRun(folder)


def rerun(
    run: AnyRun,
    indices: Iterable[int] | int = (),
    *,
    vut: AnyVut | None = None,
    level: int | str | None = None,
    net: Path | str | None = None,
    trust_vut: bool = False,
    workers: int = 1,
    dask: str | None = None,
    progress: bool | None = None,
    **hosting: Unpack[Hosting],
) -> Rerun:
    """Run recorded cases again with a changed VUT; the same as `merge-sumo rerun`.

    Args:
        run: the campaign, or its folder.
        indices: its cases; all of them by default.
        vut: as of `campaign`; the campaign's, as its files are now, by default.
        level: only the cases with a POV of this level; "all" by default.
        net: net for that; must be the one of the campaign.
        trust_vut: run the controller that a folder names although it was not made here.
        workers: processes that run cases.
        dask: address of a Dask scheduler whose workers run the cases instead.
        progress: show progress; by default in a notebook and on a terminal.
        hosting: others to change: `policies`, `pov`, `vut_command`, `deadline_s`,
            `vut_memory_gib`, `in_process`; see `Setup`.

    Raises `UserError` for a case that does not exist, and for another net or POV than recorded.
    """
    check_keywords("rerun", hosting, Hosting)
    before, count = opened(run).run, workers_or_cores(workers)
    wanted = _of_level(before, _listed(indices), level)
    given = dict(hosting)
    if vut is not None or hosting.get("pov") is not None:
        spec, pov, able = drivers_of("" if vut is None else vut, hosting.get("pov"), workers)
        given |= {name: one for name, one in (("vut", spec), ("pov", pov)) if one}
        count = able or count
    today = settings_today(before, recordable(given), trust=trust_vut)
    total = len(set(wanted) or before.outcomes)
    with (
        open_workers(today.workers(count), dask) as there,
        Counter(f"{today.vut} again", total, "cases", shown=progress) as counter,
    ):
        road = None if net is None else Path(net)
        return versions.rerun(before, today, wanted, net=road, workers=there, on_case=counter.ended)


def _of_level(run: Run, indices: tuple[int, ...], level: int | str | None) -> tuple[int, ...]:
    """Return the cases of a level among some, or among all."""
    if level is None or str(level) == "all":
        return indices
    by_name = {level_name(number): number for number in run.settings.get("levels", ())}
    if str(level) not in by_name:
        names = ", ".join(by_name)
        raise UserError(f"{run.folder} has no cases at level {level}: it has {names}, or all")
    among = [run.outcome(index) for index in indices] or run.outcomes
    found = tuple(o.index for o in among if o.case.level == by_name[str(level)])
    if not found:
        raise UserError(f"none of these cases of {run.folder} is of level {level}")
    return found


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
    first, second = opened(a).run, opened(b).run
    given = {} if policies is None else {"policies": str(policies)}
    road = road_for(first.scenario, None if net is None else Path(net)) if rerun else None
    motions: dict[tuple[str, int], Trajectory] = {}

    def keep(of: str, index: int, trajectory: Trajectory) -> None:
        motions[of, index] = trajectory

    compared = versions.compare_runs(
        first, second, rerun=rerun, net=road, given=given, trust=trust_vut, on_motion=keep
    )
    if out is not None:
        write_page(comparison_page(compared, first, second, motions, tolerance), Path(out))
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
    found = history_of([opened(run).run for run in runs])
    if out is not None:
        write_page(history_page(found), Path(out))
    return found


def _listed(indices: Iterable[int] | int) -> tuple[int, ...]:
    return tuple(indices) if isinstance(indices, Iterable) else (int(indices),)


EXPORTS: Final = "exports"
TABLES: Final = ("csv", "parquet")
FOLDERS: Final = {"sumo": exports.write_sumo, "openscenario": exports.write_openscenario}
"""Formats of `export`: a table of all cases, or a folder for each."""


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
    loaded = opened(run).run
    wanted = None if indices is None else list(_listed(indices))
    if out is None:
        check_own(loaded.folder / SCENARIOS, loaded.folder / EXPORTS)
    if file_format in TABLES:
        wanted = wanted or [outcome.index for outcome in loaded.outcomes]
        folder = Path(out) if out is not None else loaded.folder / EXPORTS
        return [exports.write_table(loaded, wanted, folder, file_format)]
    if file_format not in FOLDERS:
        names = ", ".join((*FOLDERS, *TABLES))
        raise UserError(f"there is no format {file_format!r}: choose one of {names}")
    if not wanted:
        raise UserError(f"--format {file_format} needs the indices of cases")
    below = SCENARIOS if file_format == "sumo" else EXPORTS
    target = Path(out) if out is not None else loaded.folder / below
    road = road_for(loaded.scenario, None if net is None else Path(net))
    return list(exports.write_folders(loaded, wanted, target, FOLDERS[file_format], road))


def report(run: AnyRun) -> Path:
    """Write the report of a campaign again and return its path; as `merge-sumo report`."""
    return opened(run).report()


def replay(folder: AnyRun, index: int | None = None, *, net: Path | str | None = None) -> Replay:
    """Replay a case in SUMO and compare every row with its record; as `merge-sumo replay`.

    Args:
        folder: a scenario folder, or a campaign.
        index: the case of the campaign, which is exported where it is not yet.
        net: SUMO net to use instead of the scenario's.

    `diverged_at_s` of what is returned is None where the replay is identical.
    """
    return replayer.replay(_scenario_folder(folder, index, net))


def open_in_gui(folder: AnyRun, index: int | None = None, *, net: Path | str | None = None) -> int:
    """Show a case in sumo-gui until the window is closed; return the exit code of sumo-gui.

    The arguments are those of `replay`. Raises `UserError` without a display.
    """
    return replayer.open_gui(_scenario_folder(folder, index, net))


def _scenario_folder(folder: AnyRun, index: int | None, net: Path | str | None) -> Path:
    """Return the replay folder of a case, which is written where it is not there yet."""
    place = folder.folder if isinstance(folder, CampaignRun) else Path(folder)
    if not (place / SETTINGS).is_file():
        if index is not None:
            raise UserError(f"{place} is no campaign, so it has no case {index}: leave that away")
        return place
    if index is None:
        raise UserError(
            f"{place} is a campaign: say which case, as in `merge-sumo replay {quoted(place)} 3`"
        )
    exported = place / SCENARIOS / case_name(index)
    if not exported.is_dir():
        export(folder, index, net=net)
    return exported


def opened(run: AnyRun) -> CampaignRun:
    """Return a campaign that may be named by its folder."""
    return run if isinstance(run, CampaignRun) else CampaignRun(run)
