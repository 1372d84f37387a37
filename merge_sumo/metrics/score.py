"""The outcome of a case: its measures, its margin, and its line in the records."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any, get_type_hints

from merge_sumo.metrics.measures import FOLLOW_UP, OURS, Measures, measures_in
from merge_sumo.metrics.paper import margin_of
from merge_sumo.metrics.prediction import Prediction
from merge_sumo.records import convert, decode, record_type, to_plain
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import Scenario


@dataclass(frozen=True, slots=True)
class Outcome:
    """A case that was run: its place in the campaign, its measures, and what was predicted of it.

    Attributes:
        index: its place in the campaign.
        batch: the batch in which it ran.
        case: the case.
        measures: what was measured.
        prediction: what was predicted of it; None without a prediction.
        margin: how far it is from failing under the campaign's criterion, below 0 where it fails,
            without a unit; by default that of the score P; None after an error.
    """

    index: int
    batch: int
    case: Case
    measures: Measures
    prediction: Prediction | None = None
    margin: float | None = None

    def __post_init__(self) -> None:
        """Take the margin of the score where no other is given."""
        if self.margin is None:
            object.__setattr__(self, "margin", margin_of(self.measures.score))

    @property
    def failed(self) -> bool:
        """Whether this case is a failure of the VUT: its margin is below 0."""
        return self.margin is not None and self.margin < 0.0

    @property
    def is_by_score(self) -> bool:
        """Whether the margin is that of the score."""
        return self.margin == margin_of(self.measures.score)

    @property
    def is_tested(self) -> bool:
        """Whether this case says something of the VUT: it reached the merge point, or failed."""
        return self.measures.end.is_tested or self.failed

    @property
    def signed_gap(self) -> float | None:
        """The gap at M in units of the scenario's limit: within 1 the case fails.

        Under another criterion than the paper's it is what stands for it: 1 + m at a margin m of 0
        or more, and 1 / (1 - m) below. Negative where the VUT goes first; None after an error, and
        where the paper's criterion has no gap.
        """
        dx_m, margin = self.measures.dx_m, self.margin
        if margin is None or self.is_by_score:
            return None if dx_m is None else dx_m / self.case.scenario.dx_crash_m
        gap = 1.0 + margin if margin >= 0.0 else 1.0 / (1.0 - margin)
        return -gap if dx_m is not None and dx_m < 0.0 else gap

    def to_record(self) -> dict[str, Any]:
        """Return the flat, JSON-ready record that `outcomes.jsonl` holds, units in the names."""
        scenario = self.case.scenario
        record: dict[str, Any] = {"index": self.index, "batch": self.batch}
        for name in ("level", *scenario.case_fields):
            record[name] = getattr(self.case, name)
        if self.case.draw:
            record["draw"] = self.case.draw
        for name in measures_in(scenario):
            record[name] = self.measures.value(name)
        if not self.is_by_score:
            record["margin"] = self.margin
        if self.prediction is not None:
            record["foretold"] = to_plain(self.prediction)
        return record

    @classmethod
    def from_json(cls, line: bytes | str, scenario: Scenario) -> Outcome:
        """Return the outcome of a line of `outcomes.jsonl`; `UserError` where it is none."""
        known = convert(decode(line), record_of(scenario))
        coordinates = {name: getattr(known, name) for name in ("level", *scenario.case_fields)}
        case = Case(**coordinates, draw=known.draw, scenario=scenario)
        measures = Measures(**{name: getattr(known, name) for name in measures_in(scenario)})
        return cls(known.index, known.batch, case, measures, known.foretold, known.margin)


@lru_cache
def record_of(scenario: Scenario) -> Any:
    """Return the type of the records of a scenario."""
    types = {"index": int, "batch": int, **get_type_hints(Case)}
    required = [(name, types[name]) for name in ("index", "batch", "level", *scenario.case_fields)]
    optional: list[tuple[str, Any, Any]] = []
    for name, one in measures_in(scenario).items():
        if name in OURS and one.only_with != FOLLOW_UP:
            required.append((name, get_type_hints(one.of)["return"]))
        else:
            optional.append((name, float | None, None))
    optional += [
        ("draw", int, 0),
        ("margin", float | None, None),
        ("foretold", Prediction | None, None),
    ]
    return record_type("outcome", [*required, *optional])
