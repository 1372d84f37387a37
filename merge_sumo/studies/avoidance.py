"""Who would have avoided a failure: reference drivers in the very same case.

Every failure of a campaign is driven again, without the VUT and without running any code of it:

- by each reference driver in the VUT's place, from the start;
- by the FSM driver that takes over: until some time the VUT does what it did, by its recorded
  accelerations, and from then on the driver is at the wheel, with its delay still to come. Every
  step is tried from the last one back, up to the first success: success is not monotone in time;
- with a careful driver on the mainline in the POV's place, against what the VUT did.

avoidance.jsonl         in the folder of the campaign: one line per failure, in the order of cases;
                        of very many, the worst

That of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, Final

from merge_sumo.campaigns.store import Run, failures
from merge_sumo.engine.evaluate import workers_or_here
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.studies.counterfactuals import CAREFUL, Avoidance, Failure, drive_again
from merge_sumo.system.folders import replace_own
from merge_sumo.system.records import read_indexed
from merge_sumo.system.workers import Workers
from merge_sumo.values.score import Outcome
from merge_sumo.values.trajectory import Trajectory
from merge_sumo.vuts.output import LOG
from merge_sumo.vuts.registry import vut_factory

AVOIDANCE: Final = "avoidance.jsonl"
MOST: Final = 500
"""Failures that are driven again, the worst: each takes some thirty episodes."""
CHUNK: Final = 64
"""Failures that a worker takes at a time: enough to keep all corridors busy."""


def avoidance(
    run: Run,
    plan: SimulationPlan,
    *,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
    on_part: Callable[[int, int], None] = lambda _done, _total: None,
) -> list[Avoidance]:
    """Return who would have avoided each failure of a campaign, in the order of its cases.

    Of more than `MOST` failures, of the worst ones. Failures whose trajectory is lost, and those
    that end a worker each time, are left out. The POVs are those of the plan; a POV of the
    tester's own runs again.

    Args:
        run: the campaign.
        plan: how it was run.
        workers: where the failures are driven again, by default in this process.
        check: called whenever a worker is done with some of them; may raise to stop there.
        on_part: told how many failures are done, and how many there are, from 0 on.
    """
    found = sorted(failures(run.outcomes)[:MOST], key=lambda outcome: outcome.index)
    known = {o.index: motion for o in found if (motion := _trajectory(run, o)) is not None}
    if not known:
        return []
    # No code of the VUT: a driver of the package is in its place.
    plan = replace(plan, vut=vut_factory(CAREFUL)).with_log(run.folder.resolve() / LOG)
    again, failing = partial(drive_again, plan), list(known.items())
    avoided: list[Avoidance] = []
    with workers_or_here(workers) as there:
        on_part(done := 0, len(failing))
        size = min(CHUNK, math.ceil(len(failing) / there.count))
        chunks = (failing[first : first + size] for first in range(0, len(failing), size))
        with closing(there.run_chunks(again, chunks, _nothing_known)) as results:
            for _, some in results:
                avoided += [one for one in some if one is not None]
                on_part(done := done + len(some), len(failing))
                check()
    return sorted(avoided, key=lambda one: one.index)


def _trajectory(run: Run, outcome: Outcome) -> Trajectory | None:
    try:
        return run.trajectory(outcome.index)
    except UserError:
        return None


def _nothing_known(_: Failure) -> None:
    """Return what is said of a failure that ended every worker that drove it again."""


def note_avoidance(
    run: Run,
    plan: SimulationPlan,
    *,
    workers: Workers | None = None,
    check: Callable[[], None] = lambda: None,
    on_part: Callable[[int, int], None] = lambda _done, _total: None,
) -> str | None:
    """Find and write who would have avoided the failures of a campaign; return it in a sentence.

    The arguments are those of `avoidance`.
    """
    found = avoidance(run, plan, workers=workers, check=check, on_part=on_part)
    if not found:
        return None
    write_avoidance(run.folder, found)
    return in_a_sentence(found)


def write_avoidance(folder: Path, found: Iterable[Avoidance]) -> Path:
    """Write what was found into the folder of a campaign, in the place of an older one."""
    path = folder / AVOIDANCE
    lines = "".join(json.dumps(asdict(one), allow_nan=False) + "\n" for one in found)
    replace_own(path, lines.encode())
    return path


def read_avoidance(run: Run) -> dict[int, Avoidance]:
    """Return by index what the folder of a campaign says of its failures.

    Empty where it says nothing. Raises `UserError` for a line that is not of one of its failures.
    """
    failing = {outcome.index for outcome in run.outcomes if outcome.failed}
    return read_indexed(run.folder / AVOIDANCE, Avoidance, failing, _upgrade_from_0_1)


def _upgrade_from_0_1(record: dict[str, Any]) -> dict[str, Any]:
    # Another driver took over in that release, so the time says nothing of this one.
    if "careful_until_s" in record:
        record["latest_takeover_s"] = None
        del record["careful_until_s"]
    return record


def in_a_sentence(found: Iterable[Avoidance]) -> str | None:
    """Return how many failures careful drivers would have avoided; None where nothing is known."""
    known = list(found)
    if not known:
        return None
    count = sum(one.by_careful for one in known)
    pov = sum(one.pov_careful for one in known)
    ahead = sum(one.by_who_takes_over for one in known)
    times = sorted(one.latest_takeover_s for one in known if one.latest_takeover_s is not None)
    plural = "failure" if len(known) == 1 else "failures"
    said = (
        f"{count} of {len(known)} {plural} would have been avoided by a careful and competent "
        f"driver, {ahead} by the fuzzy safety model"
    )
    if times:
        middle = times[math.floor((len(times) - 1) / 2)]
        said += f" (which may take over until {middle:.1f} s, in the median)"
    return f"{said}, and {pov} by a careful driver on the mainline."
