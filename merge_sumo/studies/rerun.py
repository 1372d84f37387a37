"""Recorded cases again, with a changed VUT: which verdicts changed, and whether it is worse."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from merge_sumo.analysis.result import Result
from merge_sumo.analysis.verdict import counted, judge
from merge_sumo.campaigns.campaign import workers_or_here
from merge_sumo.campaigns.plan import plan_of
from merge_sumo.campaigns.repeats import cause
from merge_sumo.campaigns.run import Run
from merge_sumo.campaigns.settings import CampaignSettings, record_of, same_pov, settings_of
from merge_sumo.engine.simulator import road_for, runs_on
from merge_sumo.engine.versions import versions
from merge_sumo.errors import UserError
from merge_sumo.studies.changes import Change, RunComparison
from merge_sumo.studies.comparison import compared_case, level_change, telling
from merge_sumo.system.workers import Workers
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome
from merge_sumo.vuts.files import changed
from merge_sumo.vuts.registry import built_in_vuts


@dataclass(frozen=True, slots=True)
class ChangedVerdict:
    """A case whose verdict is another than the recorded one."""

    before: Outcome
    after: Outcome

    @property
    def change(self) -> str:
        """What that means: fixed, broke, or between failing and giving no verdict."""
        return compared_case("A", self.before, self.before, self.after).change

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        was, now = self.before.measures, self.after.measures
        return {
            "index": self.before.index,
            "level": self.before.case.level,
            "change": self.change,
            **{"end_before": was.end, "end_after": now.end},
            **{"severity_before": was.severity, "severity_after": now.severity},
            **{"score_before": self.before.score, "score_after": self.after.score},
        }


MOST_CHANGED: Final = 40
"""Changed verdicts that are printed; `changed` has all."""


@dataclass(frozen=True, slots=True, repr=False)
class Rerun(Result):
    """Recorded cases and what the VUT of today makes of them.

    Attributes:
        vut: name of that VUT.
        before: the recorded outcomes.
        after: those of today, in the same order, with the same indices.
        compared: what changed, as in `compare_runs`: A is what was recorded, B is today's.
        unrepeated: indices of the cases that did not go as before although the VUT is the same, by
            its name, its command and its files; empty where it is another one.
    """

    vut: str
    before: list[Outcome]
    after: list[Outcome]
    compared: RunComparison
    unrepeated: tuple[int, ...] = ()

    @property
    def changed(self) -> list[ChangedVerdict]:
        """The cases whose verdict changed, in the order of the campaign."""
        pairs = zip(self.before, self.after, strict=True)
        return [
            ChangedVerdict(a, b)
            for a, b in pairs
            if (a.measures.end, a.failed) != (b.measures.end, b.failed)
        ]

    def to_record(self) -> dict[str, Any]:
        """Return what `--json` prints."""
        return {
            "vut": self.vut,
            "cases": len(self.before),
            "changed": [one.to_record() for one in self.changed],
            "levels": self.compared.to_record()["levels"],
            "unrepeated": self.unrepeated,
        }

    def lines(self) -> list[str]:
        """Return both verdicts, and which cases changed theirs."""
        now, changed = judge(self.after), self.changed
        said = [f"recorded:  {judge(self.before).counts}", f"now:       {now.counts} ({self.vut})"]
        said += now.trouble_lines()
        if self.unrepeated:
            said.append(
                f"{len(self.unrepeated)} of {counted(len(self.after), 'case')} went differently, "
                f"and no file of the VUT has changed (the first is case {self.unrepeated[0]}). "
                f"{cause()}."
            )
        if not changed:
            return [*said, "no verdict changed"]
        said.append(
            f"{len(changed)} verdicts changed:" if len(changed) > 1 else "one verdict changed:"
        )
        for one in changed[:MOST_CHANGED]:
            became = _became(one.before, one.after)
            change = one.change.replace("of A", "before").replace("of B", "now")
            said.append(f"  case {one.before.index}: {became} ({change})")
        if len(changed) > MOST_CHANGED:
            said.append(f"  and {len(changed) - MOST_CHANGED} others")
        return said


def _became(before: Outcome, after: Outcome) -> str:
    """Return what became of a case before and now; where the words are one, which is a failure."""
    words = [one.measures.became for one in (before, after)]
    if words[0] == words[1]:
        words = [
            f"{word}, {'a failure' if one.failed else 'no failure'}"
            for word, one in zip(words, (before, after), strict=True)
        ]
    return " -> ".join(words)


def settings_today(
    run: Run, given: Mapping[str, object] | None = None, *, trust: bool = False
) -> CampaignSettings:
    """Return the settings of a campaign with what is given in the place of what it recorded.

    A VUT that is not given is that of the campaign, as its files are today. The controller that a
    folder names runs only where the folder was made here, or with `trust`.
    """
    wanted = dict(given or {})
    if "vut" in wanted:
        wanted.setdefault("vut_command", None)  # the command was that of the VUT that was
    return settings_of(run.folder, run.settings, wanted, trust=trust)


def rerun(
    run: Run,
    settings: CampaignSettings,
    indices: Sequence[int] = (),
    *,
    net: Path | None = None,
    workers: Workers | None = None,
    on_case: Callable[[int], None] = lambda _: None,
) -> Rerun:
    """Run cases of a campaign again.

    Args:
        run: the campaign.
        settings: how: `settings_today`.
        indices: its cases; all of them when left out.
        net: net for that; must be the one of the campaign.
        workers: where the cases run, by default in this process.
        on_case: told how many cases have just ended.

    Raises `UserError` for an index without a case, and where net or POV are not those of the
    campaign: then not only the VUT would have changed.
    """
    before = [run.outcome(index) for index in dict.fromkeys(indices)] or run.outcomes
    if not before:
        raise UserError(f"{run.folder} has no case yet")
    road = road_for(settings.scenario, net)
    today = record_of(settings, road)
    if run.settings.get("net_sha256", road.sha256) != road.sha256:
        raise UserError(
            f"{run.folder} was run on another net than {road.path}: give that with --net"
        )
    levels = sorted({outcome.case.level for outcome in before})
    for level in levels:
        if not same_pov(run.settings, today, level):
            raise UserError(
                f"{run.folder} was run against another POV of level {level_name(level)} than "
                "today's: give its --policies"
            )
    plan = plan_of(settings, road, cases=len(before))
    # In another order than the campaign's, which a VUT that remembers would repeat.
    order, after = before[::-1], dict[int, Outcome]()
    with workers_or_here(workers) as there:
        for place, ran in runs_on(there, plan)([outcome.case for outcome in order]):
            was = order[place]
            now = Outcome(was.index, was.batch, was.case, ran.measures, margin=ran.margin)
            after[was.index] = now
            on_case(1)
    again = [after[outcome.index] for outcome in before]
    unrepeated = _unrepeated(before, again) if _same_vut(run, settings) else ()
    return Rerun(settings.vut, before, again, _compared(levels, before, again), unrepeated)


def _same_vut(run: Run, settings: CampaignSettings) -> bool:
    """Return whether a VUT that is not of the package is the one that was recorded."""
    recorded, files = run.settings, run.settings.get("vut_files")
    return (
        settings.vut not in built_in_vuts()
        and (settings.vut, settings.vut_command)
        == (recorded.get("vut"), recorded.get("vut_command"))
        and recorded.get("versions") == versions()
        and isinstance(files, dict)
        and not changed(files)
    )


def _unrepeated(before: Sequence[Outcome], after: Sequence[Outcome]) -> tuple[int, ...]:
    """Return the indices of the cases that did not go as before, but for those with an error."""

    def motion(outcome: Outcome) -> tuple[object, ...]:
        found = outcome.measures
        return found.end, found.t_end_s, found.dx_m, found.dv_mps, found.clipped_steps

    return tuple(
        a.index
        for a, b in zip(before, after, strict=True)
        if not (a.measures.end.is_error or b.measures.end.is_error) and motion(a) != motion(b)
    )


def _compared(
    levels: Sequence[int], before: Sequence[Outcome], after: Sequence[Outcome]
) -> RunComparison:
    """Compare outcomes of the same cases."""
    cases = [
        compared_case("A", a, a, b)
        for a, b in zip(before, after, strict=True)
        if any(o.failed or not o.is_tested for o in (a, b))
    ]
    cases.sort(key=telling)
    by_level = {
        level: level_change(level, cases, before, after, same_cases=True) for level in levels
    }
    assert all(case.change is not Change.NOT_RUN_AGAIN for case in cases), "all ran"  # noqa: S101
    return RunComparison(by_level, cases, f"{counted(len(before), 'case')} ran again")
