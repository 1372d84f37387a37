"""Failures beside published figures of people: would a driver on the mainline do what the POV did?

A behaviour of the POV is within a share of people where the figures do not show that fewer people
than the others do as much. The figures are steps: nothing is assumed between them. Braking and
slow-down decide, which the POV does itself; the order at M, time to collision and headway depend on
the VUT, too, and stand beside them.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any, Final

from merge_sumo.analysis.merging import REAR_HEADWAY_S, SITES, SOURCE
from merge_sumo.errors import UserError
from merge_sumo.system.printable import counted
from merge_sumo.values.case import to_unit
from merge_sumo.values.fmc import fmc
from merge_sumo.values.scenario import OWN, POV, VEHICLES, MergeScenario, Scenario, level_name
from merge_sumo.values.score import Outcome

ALL_PEOPLE: Final = 1.0
"""Share of people by default: within the hardest of them."""
CONFIDENCE: Final = 0.95
"""Of the bound on the share of drivers that would do what none of these did."""
ROUNDING: Final = 1e-9
"""Within which two shares are the same."""


@dataclass(frozen=True, slots=True)
class Step:
    """A published figure: the share of people of whom a value was above `above`.

    A share of 0 is at their maximum, which one of them reached.
    """

    above: float
    share: float


@dataclass(frozen=True, slots=True)
class Place:
    """Share of people who did at least as much, as far as the figures tell: from, to."""

    at_least: float
    at_most: float


@dataclass(frozen=True, slots=True)
class PublishedMeasure:
    """What is published of a behaviour of people, as steps.

    Attributes:
        name: of the measure of the POV that is held against it.
        about: what it is, in a phrase.
        unit: unit of the steps.
        people: number of people.
        steps: figures, the least first.
    """

    name: str
    about: str
    unit: str
    people: int
    steps: tuple[Step, ...]

    @property
    def in_words(self) -> list[str]:
        """The steps in words, in people where they are counted."""
        counts = [step.share * self.people for step in self.steps]
        counted_in = all(abs(count - round(count)) < ROUNDING for count in counts)
        shares = [
            f"{round(count)} of {self.people}" if counted_in else f"{step.share:.0%}"
            for count, step in zip(counts, self.steps, strict=True)
        ]
        return [f"{of} above {s.above:g}" for of, s in zip(shares, self.steps, strict=True)]

    def place(self, value: float) -> Place:
        """Return the share of people who did at least `value`."""
        if value <= 0.0:
            return Place(1.0, 1.0)
        least = [step.share or 1.0 / self.people for step in self.steps if step.above >= value]
        most = [step.share for step in self.steps if step.above < value]
        return Place(max(least, default=0.0), min(most, default=1.0))

    def limit(self, share: float) -> float | None:
        """Return the value that all but `1 - share` of the people keep to; None for no figure."""
        return next((s.above for s in self.steps if s.share <= 1.0 - share + ROUNDING), None)


HEE_SOURCE: Final = "HEE, drone recordings of merges on a German motorway, CC BY-SA"
HEE_PEOPLE: Final = 23
"""Drivers on the mainline whom a car merged in front of or behind, in `HEE_SOURCE`."""
HEE_MEAN_MPS: Final = 23.7
"""Their speed at the start, in the mean; the standard deviation is 1.2 m/s."""
BRAKING: Final = PublishedMeasure(
    "pov_sustained_brake_mps2",
    "hardest braking over 1.6 s",
    "m/s2",
    HEE_PEOPLE,
    (Step(0.66, 0.5), Step(1.4, 0.05), Step(2.06, 0.0)),
)
"""Median, 95 % and maximum of the hardest braking on a track (`HEE_SOURCE`). These are fits over
1.6 s: a shorter peak, as of a POV that brakes at 3 m/s2 for half a second, is less in them."""
SLOWDOWN: Final = PublishedMeasure(
    "pov_slowdown_mps",
    "slow-down before the merge",
    "m/s",
    HEE_PEOPLE,
    (Step(0.5, 5 / HEE_PEOPLE), Step(1.0, 2 / HEE_PEOPLE), Step(2.0, 1 / HEE_PEOPLE)),
)
"""Five, two and one of 23 slow by more than .5, 1 and 2 m/s; by how much more is not published
(`HEE_SOURCE`)."""
PUBLISHED: Final = (BRAKING, SLOWDOWN)
"""What decides whether a POV does as people do."""

POV_FIRST: Final = tuple(zip((site.name for site in SITES), (0.077, 0.101, 0.011), strict=True))
"""Share of merges in which a mainline car passes the merging car, by site (`merging.SOURCE`)."""
MEAN_TTC_S: Final = {"POV": (1.2, 2.7), "VUT": (7.0, 12.0)}
"""Means of the minimum time to collision over types of merges, of values below 15 s, where a
mainline car passes the merging car ("POV") and where none does (`merging.SOURCE`)."""


def none_of(people: int, confidence: float = CONFIDENCE) -> float:
    """Return the largest share of drivers of whom, with this confidence, none of so many is one.

    The bound of Clopper and Pearson (1934) for no success: at a share of p none of n is one with a
    chance of (1 - p)^n.
    """
    return float(1.0 - (1.0 - confidence) ** (1.0 / people))


@dataclass(frozen=True, slots=True)
class FailurePlace:
    """A failure beside people.

    Attributes:
        braking: share of people who braked at least as hard as the POV; None in old records, as
            the next.
        slowdown: share of people who slowed down by at least as much.
        inside: whether no figure shows that the POV did more than the share of people.
    """

    braking: Place | None
    slowdown: Place | None
    inside: bool


@dataclass(frozen=True, slots=True)
class LevelBesidePeople:
    """Failures at a POV level beside people, and what the POVs did in them.

    Attributes:
        failures: failures at the level.
        inside: those in which no figure shows that the POV did more than the share of people.
        fmc: failure mode coverage of those inside.
        brakes_harder: failures in which the POV brakes harder over 1.6 s than the share of people.
        peaks_harder: those in which it does so for a moment alone.
        slows_more: failures in which it slows down by more.
        slows_beyond: failures in which it slows down by more than the last figure, whatever the
            share: as one of the people did, and by how much is not published.
        hardest_mps2: hardest braking of a POV over 1.6 s; None without failures, and in old
            records.
        peak_mps2: hardest braking of a POV; None without failures.
        most_mps: largest slow-down of a POV; None without failures, and in old records.
        pov_first: failures in which the POV is ahead at M.
        merged: failures in which the VUT reached M.
        ttc_s: median time to collision at M, of the failures with one.
        headway_s: median time from the VUT to the POV at M, where the VUT is ahead.
        others: failures in which the VUT met another car than the POV, in traffic.
    """

    failures: int
    inside: int
    fmc: float
    brakes_harder: int
    peaks_harder: int
    slows_more: int
    slows_beyond: int
    hardest_mps2: float | None
    peak_mps2: float | None
    most_mps: float | None
    pov_first: int
    merged: int
    ttc_s: float | None
    headway_s: float | None
    others: int

    @property
    def outside(self) -> int:
        """Failures in which the POV did more than the share of people."""
        return self.failures - self.inside


@dataclass(frozen=True, slots=True)
class PeopleSummary:
    """Failures of a campaign beside people.

    Attributes:
        share: share of people within whose behaviour a POV is inside.
        left_out: why the figures say nothing of this scenario; empty where they do.
        levels: by POV level.
        places: by index of a failing case; empty where left out.
        unknown: failures inside of which a measure would decide that is not recorded.
    """

    share: float
    left_out: str
    levels: dict[int, LevelBesidePeople]
    places: dict[int, FailurePlace]
    unknown: int

    @property
    def failures(self) -> int:
        """Failures at all levels."""
        return sum(level.failures for level in self.levels.values())

    @property
    def inside(self) -> int:
        """Failures inside at all levels."""
        return sum(level.inside for level in self.levels.values())

    @property
    def limits(self) -> str:
        """What a POV inside does at most, in a phrase."""
        braking, slowdown = (published.limit(self.share) for published in PUBLISHED)
        parts = [] if braking is None else [f"brakes at {braking:g} m/s2 or less over 1.6 s"]
        parts += [] if slowdown is None else [f"slows down by {slowdown:g} m/s or less"]
        return " and ".join(parts)

    @property
    def people(self) -> str:
        """The people whom a POV inside does not exceed, in a phrase."""
        some = "the hardest" if self.share == ALL_PEOPLE else f"{100.0 * self.share:g} %"
        return f"{some} of {HEE_PEOPLE} published drivers"

    @property
    def car(self) -> str:
        """The car of the mainline that is held against people: in traffic the one the VUT meets."""
        others = any(one.others for one in self.levels.values())
        return "the car that the VUT meets" if others else "the POV"

    @property
    def line(self) -> str | None:
        """The result in a line; None without failures."""
        if not self.failures:
            return None
        if self.left_out:
            return f"beside people: {self.left_out}"
        fmcs = ", ".join(
            f"{one.fmc:.4f} at level {level_name(level)}"
            for level, one in self.levels.items()
            if one.failures
        )
        return (
            f"beside people: in {self.inside} of {counted(self.failures, 'failure')} {self.car} "
            f"does no more than {self.people} ({self.limits}), FMC {fmcs}"
        )

    @property
    def gate_found(self) -> str:
        """What the gate `human failures` counts, in a phrase."""
        if self.left_out:
            return f"{counted(self.inside, 'failure')}; {self.left_out}"
        return f"{counted(self.inside, 'failure')} within {self.people}"

    @property
    def findings(self) -> list[str]:
        """The POV levels that do more than people in failures, each in a sentence."""
        return (
            []
            if self.left_out
            else [
                finding
                for level, one in self.levels.items()
                for finding in self._of_level(level, one)
            ]
        )

    def _of_level(self, level: int, one: LevelBesidePeople) -> Iterator[str]:
        than = "any" if self.share == ALL_PEOPLE else f"{100.0 * self.share:g} %"
        car, drivers = _driver(level, one)
        failures = counted(one.failures, "failure")
        for number, does in (
            (one.brakes_harder, "brakes harder"),
            (one.slows_more, "slows down by more"),
        ):
            if number:
                yield (
                    f"{car} {does} than {than} of {HEE_PEOPLE} published drivers in {number} of "
                    f"{failures}: a finding about {drivers}"
                )
        if one.peaks_harder:
            yield (
                f"{car} brakes at {one.peak_mps2:g} m/s2 for a moment, in {one.peaks_harder} of "
                f"{failures} harder than {than} of {HEE_PEOPLE} published drivers over 1.6 s, and "
                "not over 1.6 s itself, so that does not decide"
            )
        if one.slows_beyond and SLOWDOWN.limit(self.share) is None:
            yield (
                f"{car} slows down by more than {SLOWDOWN.steps[-1].above:g} m/s in "
                f"{one.slows_beyond} of {failures}: 1 of {HEE_PEOPLE} published drivers did, and "
                "by how much is not published, so that does not decide"
            )

    @property
    def caveat(self) -> str:
        """What the figures of so few people can exclude, and what not, in a sentence."""
        return (
            f"What none of {HEE_PEOPLE} drivers does may still be what up to "
            f"{none_of(HEE_PEOPLE):.1%} of drivers do ({CONFIDENCE:.0%} confidence): a failure "
            "outside is rare beside these people, and not impossible"
        )

    def to_record(self) -> dict[str, Any]:
        """Return what JSON shows of it."""
        if self.left_out:
            return {"share": self.share, "failures": self.failures, "left_out": self.left_out}
        levels = {
            level_name(level): asdict(one) | {"outside": one.outside}
            for level, one in self.levels.items()
        }
        return {
            "share": self.share,
            "failures": self.failures,
            "inside": self.inside,
            "unknown": self.unknown,
            "levels": levels,
            "findings": self.findings,
            "none_of_people_at_most": none_of(HEE_PEOPLE),
            "cases": {index: asdict(place) for index, place in self.places.items()},
            "people": published_record(),
        }


def published_record() -> dict[str, Any]:
    """Return the published figures as JSON shows them."""
    return {
        **{one.name: asdict(one) | {"source": HEE_SOURCE} for one in PUBLISHED},
        "merged_first": {"POV": dict(POV_FIRST), "source": SOURCE},
        "ttc_s": {"means": MEAN_TTC_S, "source": SOURCE},
        "headway_s": {"medians": REAR_HEADWAY_S, "source": SOURCE},
    }


def check_share(share: float) -> float:
    """Return a share of people; `UserError` for a number that is none."""
    if not 0.0 < share <= 1.0:
        raise UserError(f"--people is {share:g}: it is a share of people, above 0 and up to 1")
    return share


def left_out_in(scenario: Scenario) -> str:
    """Return why the figures say nothing of a scenario; empty where they do."""
    if not isinstance(scenario, MergeScenario):
        return "no figures of people are published for this kind of scenario"
    fastest_mps = scenario.fastest_start_mps
    if fastest_mps < HEE_MEAN_MPS:
        return (
            f"no figures of people fit: the published drivers drive at {HEE_MEAN_MPS:g} m/s in the "
            f"mean, on a motorway, and the mainline starts at {fastest_mps:g} m/s or less here"
        )
    return ""


def beside_people(
    outcomes: Sequence[Outcome], share: float = ALL_PEOPLE, levels: Iterable[int] = ()
) -> PeopleSummary:
    """Return failures beside people.

    Args:
        outcomes: of one campaign.
        share: of people, within whose behaviour a POV is inside; 1 is within the hardest of them.
        levels: POV levels that are named also without outcomes.

    Raises:
        UserError: for a share that is none.
    """
    check_share(share)
    failing = [outcome for outcome in outcomes if outcome.failed]
    left_out = left_out_in(outcomes[0].case.scenario) if outcomes else ""
    places = {} if left_out else {o.index: place_of(o, share) for o in failing}
    every = sorted({*levels, *(outcome.case.level for outcome in outcomes)})
    of_levels = {
        level: _level([o for o in failing if o.case.level == level], places, share, level)
        for level in every
    }
    unknown = sum(places[o.index].inside and _is_unknown(o, share) for o in failing if places)
    return PeopleSummary(share, left_out, of_levels, places, unknown)


def place_of(outcome: Outcome, share: float = ALL_PEOPLE) -> FailurePlace:
    """Return the place of what the POV did among people."""
    measures = outcome.measures
    values = [measures.value(published.name) for published in PUBLISHED]
    limits = [published.limit(share) for published in PUBLISHED]
    braking, slowdown = (
        None if value is None else published.place(value)
        for value, published in zip(values, PUBLISHED, strict=True)
    )
    return FailurePlace(braking, slowdown, inside=not any(map(_exceeds, values, limits)))


def _is_unknown(outcome: Outcome, share: float) -> bool:
    """Return whether a measure is not recorded that could show that the POV is outside.

    Sustained braking is never harder than the hardest braking, which is always recorded.
    """
    measures = outcome.measures
    if measures.pov_slowdown_mps is not None:
        return False
    may_slow = SLOWDOWN.limit(share) is not None
    return may_slow or _exceeds(measures.pov_max_brake_mps2, BRAKING.limit(share))


def _exceeds(value: float | None, limit: float | None) -> bool:
    return value is not None and limit is not None and value > limit + ROUNDING


def _level(
    failing: Sequence[Outcome],
    places: dict[int, FailurePlace],
    share: float,
    level: int,
) -> LevelBesidePeople:
    """Return what is found at a level; without places all are inside: no figure says otherwise."""
    limits = [published.limit(share) if places else None for published in PUBLISHED]
    inside = [o for o in failing if o.index not in places or places[o.index].inside]
    measured = [o.measures for o in failing]
    slowdowns = [m.pov_slowdown_mps for m in measured]
    brakings = [m.pov_sustained_brake_mps2 for m in measured]
    harder = [_exceeds(braking, limits[0]) for braking in brakings]
    peaks = [_exceeds(m.pov_max_brake_mps2, limits[0]) for m in measured]
    behind = [m.pet_s for m in measured if m.merged_first == "VUT"]
    return LevelBesidePeople(
        failures=len(failing),
        inside=len(inside),
        fmc=fmc(to_unit((o.case for o in inside), level)),
        brakes_harder=sum(harder),
        peaks_harder=sum(
            peak and not sustained and braking is not None
            for peak, sustained, braking in zip(peaks, harder, brakings, strict=True)
        ),
        slows_more=sum(_exceeds(slowdown, limits[1]) for slowdown in slowdowns),
        slows_beyond=sum(_exceeds(slowdown, SLOWDOWN.steps[-1].above) for slowdown in slowdowns),
        hardest_mps2=max((a for a in brakings if a is not None), default=None),
        peak_mps2=max((m.pov_max_brake_mps2 for m in measured), default=None),
        most_mps=max((v for v in slowdowns if v is not None), default=None),
        pov_first=sum(m.merged_first == "POV" for m in measured),
        merged=sum(m.merged_first is not None for m in measured),
        ttc_s=_median(m.ttc_s for m in measured),
        headway_s=_median(behind),
        others=sum(m.nearest != VEHICLES[POV] for m in measured),
    )


def _median(values: Iterable[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return median(known) if known else None


def _driver(level: int, found: LevelBesidePeople) -> tuple[str, str]:
    """Return the car that did so at a level, and of which drivers that is a finding, in phrases."""
    if found.others:
        return f"the car met at level {level_name(level)}", "the drivers of this traffic"
    if level == OWN:
        return "the POV of your own", "this POV"
    return f"level {level_name(level)}", "this library of drivers"
