"""The keywords that the verbs of the API share, and the settings that they make."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypedDict

from merge_sumo.campaigns.settings import CampaignSettings, parse_levels, povs_of
from merge_sumo.errors import Notice, UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.values.scenario import DEADLINE_S, MEMORY_GIB, US23, Scenario
from merge_sumo.vuts.base import VutOptions
from merge_sumo.vuts.in_memory import AnyVut, drivers_of


class Setup(TypedDict, total=False):
    """How a case is run and judged: keywords of `campaign`, `truth` and others, none required.

    Attributes:
        scenario: a `Scenario`, its name, or its TOML file; "us23" by default.
        follow_up_s: time in s for which both drive on after the merge; the scenario's by default.
        policies: folder of learned drivers instead of the shipped ones.
        pov: a POV of your own, at level "own": anything that `vut` takes, but not "traci".
        fail_when: what counts as a failure: the name of a criterion, or a condition over the
            measures.
        require: what must hold over time instead, in signal temporal logic.
        vut_command: command that starts the controller of `vut="traci"`.
        deadline_s: time in s that a VUT may take for a step before the case is a VUT_ERROR.
        vut_memory_gib: memory in GiB that the process of a VUT of your own may take.
        in_process: run such a VUT in this process, where a debugger reaches it.
    """

    scenario: Scenario | Path | str
    follow_up_s: float | None
    policies: Path | str | None
    pov: AnyVut | None
    fail_when: str
    require: str | None
    vut_command: str | None
    deadline_s: float
    vut_memory_gib: float
    in_process: bool


class CaseKeywords(Setup, total=False):
    """What `run_case` may be given: the keywords of `Setup`, and the coordinates of the case.

    Attributes:
        x_pov0_m: initial position of the POV's front bumper, relative to M, in m.
        v_pov0_mps: initial speed of the POV.
        svo_rad: social value orientation of the POV, at level 2.
        v_vut0_mps: initial speed of the VUT; the scenario's by default.
        headway_ahead_s: headway to the car ahead, in traffic.
        headway_behind_s: headway of the car behind, in traffic.
    """

    x_pov0_m: float
    v_pov0_mps: float
    svo_rad: float
    v_vut0_mps: float
    headway_ahead_s: float
    headway_behind_s: float


class Settings(Setup, total=False):
    """What `resume` may be given again: the keywords of `campaign` that decide its outcomes."""

    vut: AnyVut
    level: int | str
    sampler: str
    cases: int
    batch: int | None
    seed: int
    v_vut0_mps: float | None
    stop_after_converged: float | None
    learn_from: Sequence[Path | str]


class Hosting(TypedDict, total=False):
    """What `rerun` and `probability` may have otherwise than the campaign: see `Setup`."""

    policies: Path | str | None
    pov: AnyVut | None
    vut_command: str | None
    deadline_s: float
    vut_memory_gib: float
    in_process: bool


def no_check() -> None:
    """Let a verb go on: what is called after every batch where nothing else is."""


def check_keywords(function: str, given: Mapping[str, Any], known: Any) -> None:
    """Raise `TypeError`, as Python does, for a keyword that a function does not have."""
    names = known.__optional_keys__
    unknown = sorted(given.keys() - names)
    if unknown:
        from difflib import get_close_matches

        close = get_close_matches(unknown[0], names, n=1)
        hint = f": did you mean {close[0]!r}?" if close else ""
        raise TypeError(f"{function}() got an unexpected keyword argument {unknown[0]!r}{hint}")


def scenario_of(scenario: Scenario | Path | str, follow_up_s: float | None = None) -> Scenario:
    """Return the scenario that a person names, with a follow-up of this duration in s if given."""
    found = scenario if isinstance(scenario, Scenario) else named_scenario(str(scenario))
    return found if follow_up_s is None else replace(found, follow_up_s=follow_up_s)


def recordable(given: Mapping[str, Any]) -> dict[str, Any]:
    """Return keywords of a person as `CampaignSettings` has them; `level` stays out.

    Drivers are specs by now. Raises `UserError` for a follow-up of a scenario that is not named.
    """
    named = {name: value for name, value in given.items() if name not in ("level", "follow_up_s")}
    follow_up_s = given.get("follow_up_s")
    if "scenario" in named:
        named["scenario"] = scenario_of(named["scenario"], follow_up_s)
    elif follow_up_s is not None:
        raise UserError("--follow-up is of the scenario: name that, too, with --scenario")
    if named.get("policies") is not None:
        named["policies"] = str(named["policies"])
    if "learn_from" in named:
        named["learn_from"] = tuple(map(str, named["learn_from"] or ()))
    return named


def settings_for(
    vut: AnyVut,
    level: int | str,
    setup: Mapping[str, Any],
    *,
    workers: int | None = 1,
    **search: Any,
) -> tuple[CampaignSettings, int | None]:
    """Return what a verb is to run, and on how many workers it can.

    Args:
        vut: a spec, or what Python has.
        level: POV level, or "all".
        setup: keywords of `Setup`.
        workers: number that is asked for; None is one a core.
        search: settings of a search, by their names in `CampaignSettings`.

    Raises `UserError` for values that make no settings, and warns with a `Notice` of what is odd
    about the criterion.
    """
    spec, pov_spec, workers = drivers_of(vut, setup.get("pov"), workers, stacklevel=4)
    named = recordable({"scenario": US23, **setup, **search, "pov": pov_spec})
    options = VutOptions(
        deadline_s=named.get("deadline_s", DEADLINE_S),
        memory_gib=named.get("vut_memory_gib", MEMORY_GIB),
        in_process=named.get("in_process", False),
    )
    povs = povs_of(named.get("policies"), named["scenario"], pov_spec, options)
    settings = CampaignSettings(vut=spec, levels=parse_levels(str(level), povs), **named)
    for note in settings.criterion.notes(settings.scenario):
        warnings.warn(f"note: {note}", Notice, stacklevel=3)
    return settings, workers
