"""Cases files: cases of a campaign in a small file to commit, with all that they need to run."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from merge_sumo.analysis.comparison import Change, ComparedCase
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.errors import UserError, explained
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion
from merge_sumo.metrics.measures import Measures, recorded_measures
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Outcome
from merge_sumo.records import Record, convert, read_toml, to_json
from merge_sumo.scenario.scenario import Scenario
from merge_sumo.scenario.trajectory import End
from merge_sumo.simulation.povs import POLICIES

NOTICED = 0.01
"""Loss of margin with which a case is weaker, without a unit."""


class Head(Record, frozen=True):
    """The content of a cases file.

    Attributes:
        scenario: name of the scenario, and its values other than the defaults.
        cases: a record for each case, by the names of `outcomes.jsonl`.
        tolerance: loss of margin that is not yet worse; None where no loss is worse.

    The other attributes have the names and values of `campaign.json`.
    """

    vut: str
    scenario: dict[str, Any]
    cases: list[dict[str, Any]]
    pov: str | None = None
    policies: str | None = None
    fail_when: str = PAPER_CRITERION.fail_when
    require: str | None = None
    net_sha256: str | None = None
    policies_sha256: dict[str, str] | None = None
    pov_files: dict[str, str] | None = None
    tolerance: Annotated[float, Meta(ge=0.0, le=1000.0)] | None = None


class CasesFile(RecordedCampaign):
    """A cases file, as a recorded campaign.

    Example:
        kept = CasesFile(Path("cases.toml"))
        failures = [outcome for outcome in kept.outcomes if outcome.failed]

    Attributes:
        tolerance: as in `Head`.
        accepted: reasons of failures that are accepted, by index of the case.
    """

    def __init__(self, path: Path) -> None:
        _, record = read_toml(path, "cases file")
        with explained(f"the cases file {path}"):
            head = convert(record, Head)
            scenario = convert(head.scenario, Scenario)
            if scenario.net is not None and "/" in scenario.net:
                scenario = replace(scenario, net=str((path.parent / scenario.net).resolve()))
            self.criterion = Criterion(head.fail_when, head.require)
            self.criterion.check(scenario)
            del record["cases"]
            self._take(path, {**record, "scenario": scenario.to_record()}, path)
            self.tolerance, self.torn = head.tolerance, False
            self._by_index: dict[int, Outcome] = {}
            self.accepted: dict[int, str] = {}
            for line in head.cases:
                with explained(f"case {line.get('index')!r:.40}"):
                    self._add(line)
        self.outcomes = list(self._by_index.values())
        self.record["levels"] = self.levels

    @property
    def levels(self) -> list[int]:
        """The POV levels of the cases."""
        return sorted({outcome.case.level for outcome in self.outcomes})

    def _add(self, line: dict[str, Any]) -> None:
        """Add the case of a line; raise `UserError` where it is not a case."""
        if not all(math.isfinite(one) for one in line.values() if isinstance(one, float)):
            raise UserError("a number is not finite")
        verdict, accepted = line.pop("verdict", None), line.pop("accepted", None)
        merged = Measures(end=End.MERGED, t_end_s=0.0)
        whole: dict[str, Any] = {"level": None, "batch": 0}
        whole |= dict.fromkeys(self.scenario.case_fields)
        for name in recorded_measures(self.scenario):
            whole[name] = merged.value(name)
        whole["v_vut0_mps"] = self.scenario.bounds("v_vut0_mps")[0]
        outcome = Outcome.from_json(to_json(whole | line), self.scenario)
        judged = verdict_of(outcome)
        if verdict != judged or (outcome.margin is None) != (judged == "error"):
            raise UserError(f"verdict is {verdict!r:.60}, but its margin and end give {judged}")
        if outcome.index in self._by_index:
            raise UserError("two cases have this index: remove one of them")
        self._by_index[outcome.index] = outcome
        if accepted is not None:
            if not (isinstance(accepted, str) and accepted.strip()):
                raise UserError(f"accepted is {accepted!r:.60}: it must be a text with the reason")
            self.accepted[outcome.index] = accepted

    def outcome(self, index: int) -> Outcome:
        """Return the outcome of a case.

        Args:
            index: index of the case.

        Raises:
            UserError: where the file has no such case.
        """
        if index not in self._by_index:
            raise UserError(f"{self.folder} has no case {index}")
        return self._by_index[index]

    def change_of(self, one: ComparedCase) -> Change:
        """Return the change of a case by the rules of the file.

        A new error is `BROKE` and a new contact `WORSE`, also where the case is accepted.

        Args:
            one: the case, with its outcome in the file as the earlier one.
        """
        earlier, later = one.earlier.measures, one.later.measures
        if later.error is not None and earlier.error is None:
            return Change.BROKE
        if one.earlier.passes and one.later.passes:
            lost = short(one.earlier.margin) - short(one.later.margin)
            touches = later.severity == Severity.CONTACT != earlier.severity
            if touches or (self.tolerance is not None and lost > self.tolerance):
                return Change.WORSE
            return Change.WEAKER if lost > NOTICED else Change.BOTH
        is_accepted = one.earlier.index in self.accepted and not later.end.is_error
        return Change.ACCEPTED if is_accepted and not one.later.passes else one.change


def short(value: Any) -> Any:
    """Return a number to the digits of a cases file, another value as it is.

    Args:
        value: a number, or a value of another type.
    """
    return float(f"{value:.6g}") if isinstance(value, float) else value


def verdict_of(outcome: Outcome) -> str:
    """Return the verdict on a case: pass, fail, error, or timeout.

    Args:
        outcome: the outcome of the case.
    """
    if outcome.is_tested:
        return "pass" if outcome.passes else "fail"
    return "error" if outcome.measures.end.is_error else "timeout"


def policies_of(run: RecordedCampaign, outcomes: Iterable[Outcome]) -> dict[str, str] | None:
    """Return the hashes of the learned POVs of some cases, by the names of the networks.

    Args:
        run: the campaign, which has recorded them.
        outcomes: outcomes of the cases.

    Returns:
        The hashes; None where no learned POV drives in the cases.
    """
    learned = {POLICIES.get(outcome.case.level) for outcome in outcomes}
    known = run.record.get("policies_sha256") or {}
    return {name: sha256 for name, sha256 in known.items() if name in learned} or None
