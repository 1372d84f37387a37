"""How a campaign runs from Python and from the command line: on workers, shown, and concluded."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Unpack

from merge_sumo.api.recorded import AnyRun
from merge_sumo.api.results import CampaignRun
from merge_sumo.api.setup import Settings, check_keywords, no_check, recordable
from merge_sumo.campaigns.campaign import OnCase, resume_campaign
from merge_sumo.campaigns.run import Run, read_settings
from merge_sumo.campaigns.scenario_suggestion import unseen
from merge_sumo.campaigns.settings import CampaignSettings, parse_levels, settings_of
from merge_sumo.engine.simulator import road_for
from merge_sumo.errors import Notice
from merge_sumo.reports.campaign_panel import CampaignPanel, panel_of
from merge_sumo.reports.progress import is_watched
from merge_sumo.reports.report import check_report, write_report
from merge_sumo.road.corridor import Corridor
from merge_sumo.studies.avoidance import note_avoidance
from merge_sumo.system.folders import link_latest
from merge_sumo.system.printable import quoted
from merge_sumo.system.workers import Workers, open_workers
from merge_sumo.values.scenario import Scenario, level_name
from merge_sumo.values.score import Outcome
from merge_sumo.vuts.in_memory import drivers_of


@dataclass(frozen=True, kw_only=True, slots=True)
class Running:
    """Where a campaign runs, and what is told of it; nothing of this decides an outcome."""

    workers: int | None
    dask: str | None
    on_case: OnCase | None
    check: Callable[[], None]
    progress: bool | None


def concluded(
    settings: CampaignSettings,
    folder: Path,
    road: Corridor,
    run: Callable[[Workers, CampaignPanel, OnCase], Run],
    how: Running,
) -> CampaignRun:
    """Run a campaign to its end: cases, careful drivers, report; return it.

    Args:
        settings: what it runs.
        folder: where it is written.
        road: the road.
        run: runs its cases on workers, with the panel that shows it and what is called with every
            case.
        how: where it runs.

    A `KeyboardInterrupt` has a note on how to go on.
    """
    title = f"{settings.vut} v level {'/'.join(map(level_name, settings.levels))}"
    quiet = not (is_watched() if how.progress is None else how.progress)
    try:
        with (
            open_workers(settings.workers(how.workers), how.dask) as there,
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
                if how.on_case is not None:
                    how.on_case(outcome)

            done = run(there, panel, told)
            note_avoidance(
                done,
                settings,
                road,
                workers=there,
                check=how.check,
                on_part=panel.driven_again,
            )
            link_latest(done.folder)
            result = CampaignRun(done)
            # Learned on another machine, surrogates may differ in a last bit.
            local = there if how.dask is None else None
            write_report(done, result.summary, local, panel.report_part)
            return result
    except KeyboardInterrupt as stop:
        if folder.exists():
            link_latest(folder)
            stop.add_note(f"stopped; go on with ms.resume({str(folder)!r})")
        raise


def resume(
    run: AnyRun,
    *,
    net: Path | str | None = None,
    force: bool = False,
    trust_vut: bool = False,
    workers: int = 1,
    dask: str | None = None,
    on_case: OnCase | None = None,
    check: Callable[[], None] | None = None,
    progress: bool | None = None,
    **given: Unpack[Settings],
) -> CampaignRun:
    """Go on with a campaign that was stopped; the same as `merge-sumo campaign --resume`.

    Args:
        run: the campaign, or its folder.
        net: net for that; must be the one of the campaign.
        force: go on although something differs that decides outcomes.
        trust_vut: run the controller that a folder names although it was not made here.
        workers: processes that run cases; the outcomes are the same.
        dask: address of a Dask scheduler whose workers run the cases instead.
        on_case: called with the outcome of every case as it ends.
        check: called after every batch; may raise to stop there.
        progress: show progress; by default in a notebook and on a terminal.
        given: keywords of `campaign`, which must be those of the campaign: `cases` may be more. A
            `vut` or `pov` that was an object of a process that is gone must be given again, and
            only its name tells that it is the same.

    Raises `UserError` for a folder that is no campaign, or something that differs.
    """
    check_keywords("resume", given, Settings)
    folder = run.folder if isinstance(run, CampaignRun) else Path(run)
    recorded = read_settings(folder)
    wanted: dict[str, Any] = {name: value for name, value in given.items() if value is not None}
    vut, pov = (wanted.get(name, recorded.get(name)) for name in ("vut", "pov"))
    spec, pov_spec, count = drivers_of("" if vut is None else vut, pov, workers)
    wanted |= {name: spec for name in ("vut",) if name in wanted}
    wanted |= {name: pov_spec for name in ("pov",) if name in wanted}
    named = recordable(wanted)
    settings = settings_of(folder, recorded, named, trust=trust_vut)
    if "level" in wanted:
        levels = parse_levels(str(wanted["level"]), settings.povs)
        settings, named = replace(settings, levels=levels), {**named, "levels": levels}
    check_report(folder)
    road = road_for(settings.scenario, None if net is None else Path(net))
    how = Running(
        workers=count, dask=dask, on_case=on_case, check=check or no_check, progress=progress
    )

    def go_on(there: Workers, panel: CampaignPanel, told: OnCase) -> Run:
        return resume_campaign(
            folder,
            road,
            told,
            on_before=panel.ran_before,
            given=named,
            force=force,
            workers=there,
            check=how.check,
            warn=lambda sentence: warnings.warn(sentence, Notice, stacklevel=2),
            trust=trust_vut,
        )

    return concluded(settings, folder, road, go_on, how)


def notice_unseen(
    settings: CampaignSettings, scenario: Scenario | Path | str, policies: Path | str | None
) -> None:
    """Warn with a `Notice` where the POVs were not trained on the scenario."""
    learned = {1, 2} & set(settings.levels)
    if learned and unseen(settings.scenario, settings.povs.policies):
        name = settings.scenario.name if isinstance(scenario, Scenario) else str(scenario)
        named = "" if policies is None else f" --policies {quoted(policies)}"
        warnings.warn(
            f"note: the POVs of levels 1 and 2 were not trained on {settings.scenario.name}: "
            f"`merge-sumo scenario check {quoted(name)}{named}` says in what it differs",
            Notice,
            stacklevel=3,
        )
