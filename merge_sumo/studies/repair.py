"""Repair: values of a controller's parameters with which the failures of a campaign pass.

A trial is a set of values. The failures of the campaign, its near misses and a share of its other
cases run with it. optuna proposes the trials of a search with several objectives: the cases that
still fail, the extra cost, and the change of the values; what breaks a case that passed is a
constraint. Of the trials that break nothing the choice is, in this order:

1. the fewest cases that fail;
2. the least extra cost, in steps of `COST_STEP`: nothing where the cost is that of today or less;
3. the smallest change: the sum over the parameters of the change as a share of the range.

The chosen values are then taken back towards those of today, parameter by parameter, as far as
the choice stays as good, and all cases of the campaign must pass that passed before. A fresh
campaign, which learns from nothing, tests the result. Its failures, with cases around them, join
those of the next round of the search. The round with the least FMC in its fresh campaign counts.

settings.json           in the folder of a repair: what was asked
trials.jsonl            one line per trial, in their order, synced
campaign-1/             the fresh campaign of the first round
repair.json             the result
repair.html             its page, and changes.html that of the comparison with today's values
"""

from __future__ import annotations

import hashlib
import math
import os
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, replace
from enum import StrEnum
from importlib.metadata import version
from importlib.util import find_spec
from operator import attrgetter, itemgetter
from pathlib import Path
from statistics import fmean
from typing import TYPE_CHECKING, Annotated, Any, Final

import numpy as np
from msgspec import Meta, field

from merge_sumo.analysis.result import Result
from merge_sumo.analysis.summary import summarise
from merge_sumo.campaigns.run import OUTCOMES, Run, spread_failures
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.engine.evaluate import Episodes, evaluate
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.errors import UserError
from merge_sumo.studies.comparison import Comparison, compare_outcomes, passes
from merge_sumo.system.arrays import regular
from merge_sumo.system.folders import add_to, make_folder, replace_own
from merge_sumo.system.printable import counted, quoted
from merge_sumo.system.records import Record, decode, to_json, to_plain
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case, from_unit, to_unit
from merge_sumo.values.fmc import RADIUS
from merge_sumo.values.scenario import level_name
from merge_sumo.values.score import Outcome
from merge_sumo.vuts.factory import VutFactory
from merge_sumo.vuts.parameters import Range
from merge_sumo.vuts.spec import parse

if TYPE_CHECKING:
    import optuna

SETTINGS: Final = "settings.json"
TRIALS: Final = "trials.jsonl"
RESULT: Final = "repair.json"
CAMPAIGN: Final = "campaign-{}"
PAGE: Final = "repair.html"
CHANGES: Final = "changes.html"
DEFAULT_TRIALS: Final = 60
DEFAULT_ROUNDS: Final = 3
SHARE: Final = 0.2
"""Share of the passing cases, besides near misses, that run in each trial."""
COST_STEP: Final = 0.1
"""Extra costs are compared in steps of 0.1 s, or of 0.1 m/s2. Chosen, not tuned."""
BISECTIONS: Final = 4
"""Steps by which a value is taken back towards that of today."""
RESERVE: Final = 0.25
"""Where a value cannot be taken back to that of today it goes on so far, as a share of its
change: between the cases that ran are others. Chosen, not tuned."""
NEIGHBOURS: Final = 10
"""Cases that each failure of a fresh campaign brings to the next round besides itself. Chosen, not
tuned: without any, four failures of design2 moved a threshold by 1 %, just past these four."""
MOST_INDICES: Final = 30
"""Indices of cases that a sentence names."""
MOST_AGAINST: Final = 40
"""Failures of a fresh campaign that join the next round: the worst of each region, the second of
each, and so on."""
CONFIRMED: Final = 5
"""Most trials that run all cases, the best first."""


class Cost(StrEnum):
    """What a repair may cost."""

    TIME = "time"
    BRAKING = "braking"


MEASURED_BY: Final = {Cost.TIME: ("t_end_s", "s"), Cost.BRAKING: ("vut_max_brake_mps2", "m/s2")}
"""The measure of a cost, whose mean over the cases is compared, and its unit."""


Index = Annotated[int, Meta(ge=0)]


class Trial(Record, frozen=True):
    """Values, and what became of the cases with them.

    Cases are named by their index in the campaign; those of fresh campaigns have later numbers.

    Attributes:
        round: round of the search, from 1.
        values: the values by parameter.
        fails: cases that do not pass now, of those that did not with today's values.
        broke: cases that passed with today's values and do not pass now.
        extra: by cost, its mean over the cases minus that with today's values.
        differs: whether any case ended otherwise than with today's values.
        all_cases: whether all cases ran.
        refused: why the controller does not take the values; empty where it does.
    """

    round: int
    values: dict[str, float]
    fails: tuple[Index, ...] = ()
    broke: tuple[Index, ...] = ()
    extra: dict[str, float] = field(default_factory=dict)
    differs: bool = True
    all_cases: bool = False
    refused: str = ""

    @property
    def holds(self) -> bool:
        """Whether it was run and broke nothing."""
        return not self.refused and not self.broke

    def costs_more(self, cost: Cost) -> float:
        """Return the extra cost, 0 where it costs no more than today."""
        return max(self.extra.get(cost, 0.0), 0.0)


@dataclass(frozen=True, slots=True)
class RepairSettings:
    """What is searched for.

    Attributes:
        ranges: the parameters that may change.
        cost: what the repair is to cost least of.
        trials: trials of a round, as proposed by optuna.
        rounds: most rounds of search and fresh campaign.
        cases: cases of a fresh campaign.
        seed: same seed, same result.
    """

    ranges: tuple[Range, ...]
    cost: Cost = Cost.TIME
    trials: int = DEFAULT_TRIALS
    rounds: int = DEFAULT_ROUNDS
    cases: int | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        """Raise `UserError` for values that make no search."""
        if not self.ranges:
            raise UserError("name what may change: `params` NAME=LOW..HIGH")
        least = 1 + 2 * len(self.ranges)
        for option, number, lowest in (
            ("trials", self.trials, least),
            ("rounds", self.rounds, 1),
            ("cases", self.cases or 1, 1),
            ("seed", self.seed, 0),
        ):
            if number < lowest:
                why = " for today's values and both ends of each range" * (option == "trials")
                raise UserError(f"--{option} is {number}: it must be {lowest} or more{why}")


@dataclass(frozen=True, slots=True)
class Round:
    """A round: what was chosen, and what a fresh campaign says of it.

    Attributes:
        chosen: the trial, with all cases; None where no trial is better than today's values.
        campaign: the fresh campaign.
        compared: what its cases are with today's values, and with the chosen ones.
        fmc: FMC of the failures of the fresh campaign, summed over the levels.
    """

    chosen: Trial | None
    campaign: Run | None = None
    compared: Comparison | None = None
    fmc: float = 0.0

    @property
    def broke(self) -> int:
        """Number of cases of the fresh campaign that pass with today's values alone."""
        return 0 if self.compared is None else self.compared.broke

    def to_record(self) -> dict[str, Any]:
        """Return it as JSON shows it."""
        if self.chosen is None or self.campaign is None or self.compared is None:
            return {"values": None}
        return {
            "values": self.chosen.values,
            "campaign": str(self.campaign.folder),
            "cases": len(self.campaign.outcomes),
            "failures": sum(not passes(outcome) for outcome in self.campaign.outcomes),
            "fmc": {level_name(level): row for level, row in self.compared.fmc().items()},
            "broke": self.broke,
        }


@dataclass(frozen=True, slots=True, repr=False)
class Repair(Result):
    """Values of a controller's parameters that repair it, or that there are none.

    Attributes:
        folder: folder of the repair.
        vut: the controller as it is.
        settings: what was asked.
        today: today's values.
        failing: indices of the cases of the campaign that do not pass with today's values.
        cases: number of cases of the campaign.
        rounds: the rounds.
        trials: all trials, in their order.
    """

    folder: Path
    vut: str
    settings: RepairSettings
    today: Mapping[str, float]
    failing: tuple[int, ...]
    cases: int
    rounds: tuple[Round, ...]
    trials: tuple[Trial, ...]

    @property
    def best(self) -> Round:
        """The round that counts: that whose fresh campaign has the least FMC, over all levels."""
        tested = [one for one in self.rounds if one.chosen is not None]
        return min(reversed(tested), key=attrgetter("fmc"), default=Round(None))

    @property
    def chosen(self) -> Trial | None:
        """The chosen values; None where no values help."""
        return self.best.chosen

    @property
    def spec(self) -> str | None:
        """The repaired controller as a spec."""
        if self.chosen is None:
            return None
        return str(parse(self.vut).with_values(self.chosen.values, self.today))

    @property
    def stays(self) -> tuple[int, ...]:
        """Indices of the cases of the campaign that still do not pass."""
        if self.chosen is None:
            return self.failing
        return tuple(index for index in self.chosen.fails if index < self.cases)

    @property
    def verified(self) -> bool:
        """Whether values were found, and no case of the fresh campaign broke by them."""
        return self.best.compared is not None and not self.best.compared.worse

    def change(self, trial: Trial) -> float:
        """Return by how much a trial changes today's values."""
        return change_of(trial.values, self.today, self.settings.ranges)

    def to_record(self) -> dict[str, Any]:
        """Return what `repair.json` holds, and `--json` prints."""
        chosen, ranges = self.chosen, self.settings.ranges
        values = {} if chosen is None else chosen.values
        return {
            "folder": str(self.folder),
            "vut": self.vut,
            "repaired": self.spec,
            "verified": self.verified,
            "parameters": [
                {**to_plain(one), "today": self.today[one.name], "repaired": values.get(one.name)}
                for one in ranges
            ],
            "cost": self.settings.cost.value,
            "cases": self.cases,
            "failing": list(self.failing),
            "stays": list(self.stays),
            "extra": {} if chosen is None else chosen.extra,
            "change": None if chosen is None else self.change(chosen),
            "broke": self.best.broke,
            "rounds": [one.to_record() for one in self.rounds],
            "trials": len(self.trials),
            "seed": self.settings.seed,
        }

    def lines(self) -> list[str]:
        """Return the values, what they cost, what a fresh campaign says, and the command."""
        chosen, page = self.chosen, f"page: {self.folder / PAGE}"
        failing = f"{counted(len(self.failing), 'case')} of {self.cases}"
        if chosen is None:
            return [
                f"{self.vut}: no values in these ranges let any of the {failing} pass that do not "
                "today, unless others fail that pass",
                f"  these stay: {_indices(self.stays)}",
                page,
            ]
        stays = f", {len(self.stays)} still do not: {_indices(self.stays)}" if self.stays else ""
        lines = [
            f"{self.vut}: {failing} did not pass; with other values "
            f"{len(self.failing) - len(self.stays)} of them pass{stays}; none that passed fails"
        ]
        for one in self.settings.ranges:
            today, value = self.today[one.name], chosen.values[one.name]
            lines.append(f"  {one.name}: {today:g}" + (f" -> {value:g}" if value != today else ""))
        extra = (
            f"{chosen.extra[cost]:+.2f} {unit} of {cost}" for cost, (_, unit) in MEASURED_BY.items()
        )
        lines.append(f"  cost, mean of a case: {', '.join(extra)}")
        for number, tested in enumerate(self.rounds, start=1):
            if tested.campaign is not None and tested.compared is not None:
                cases = counted(len(tested.campaign.outcomes), "case")
                lines.append(
                    f"fresh campaign {number}, {cases}: with today's values and the new ones "
                    f"{tested.compared.headline}"
                )
        if not self.verified:
            lines.append(f"not verified: {counted(self.best.broke, 'case')} broke")
        spec = quoted(self.spec or "")
        return [*lines, f"the repaired controller: merge-sumo campaign --vut {spec}", page]


def _indices(indices: Sequence[int]) -> str:
    """Return indices of cases in words."""
    shown = ", ".join(map(str, indices[:MOST_INDICES]))
    return f"{shown}, the first {MOST_INDICES}" if len(indices) > MOST_INDICES else shown


def change_of(
    values: Mapping[str, float], today: Mapping[str, float], ranges: Sequence[Range]
) -> float:
    """Return the sum over the parameters of the change as a share of the range."""
    return sum(abs(values[r.name] - today[r.name]) / (r.high - r.low) for r in ranges)


def fresh_settings(
    today: CampaignSettings, asked: RepairSettings, spec: str, number: int
) -> CampaignSettings:
    """Return the settings of the fresh campaign of a round: another seed, and no earlier lesson.

    `today` are those of the campaign before.
    """
    cases = today.cases if asked.cases is None else asked.cases
    few: dict[str, Any] = {
        name: None if (known := getattr(today, name)) is None or known > cases else known
        for name in ("batch", "in_flight")
    }
    repeat = today.repeat if isinstance(today.repeat, str) else min(today.repeat, cases)
    return replace(
        today,
        repeat=repeat,
        vut=spec,
        seed=today.seed + asked.seed + number,
        cases=cases,
        stop_when_converged=False,
        **few,
    )


def require_optuna() -> None:
    """Raise `UserError` where optuna is not installed."""
    if find_spec("optuna") is None:
        raise UserError("repair needs optuna: run `pip install 'merge-sumo[repair]'`")


ASKED: Final = {
    "cases_sha256": "the record of the campaign",
    "vut_files": "a file of the controller",
    "parameters": "`params`",
    "versions": "the version of a package",
}
"""What a setting of a repair is called where it differs; others are options of that name."""


class RepairJournal:
    """The folder of a repair: what was asked, and its trials in their order.

    A resumed repair asks for the same trials again and takes those that are recorded.
    """

    def __init__(self, folder: Path, settings: Mapping[str, Any], *, resume: bool) -> None:
        """Begin a new folder, or go on in one; `UserError` where it is of another repair."""
        self.folder, self._recorded = folder, list[Trial]()
        if not resume:
            make_folder(folder)
            replace_own(folder / SETTINGS, to_json(settings, indent=1))
            return
        before = _read(folder / SETTINGS)
        known = decode(before, dict[str, Any])
        asked = decode(to_json(settings))
        for name in asked:
            if known.get(name) != asked[name]:
                what = ASKED.get(name, f"--{name}")
                raise UserError(
                    f"{what} is not what {folder} was begun with: go on with the same command, or "
                    "begin a new folder"
                )
        if (folder / TRIALS).exists():
            lines = _read(folder / TRIALS).splitlines(keepends=True)
            whole = [line for line in lines if line.endswith(b"\n")]
            self._recorded = [decode(line, Trial) for line in whole]
            if len(whole) < len(lines):
                os.truncate(folder / TRIALS, sum(map(len, whole)))
        self._written = bool(self._recorded)

    _written = False

    def recorded(self, trial: Trial) -> Trial | None:
        """Return the next recorded trial, which is one of these values; None after the last."""
        if not self._recorded:
            return None
        known = self._recorded.pop(0)
        same = (known.round, known.values, known.all_cases)
        if same != (trial.round, trial.values, trial.all_cases):
            raise UserError(
                f"{self.folder / TRIALS} has other trials than this search: begin a new folder"
            )
        return known

    def add(self, trial: Trial) -> None:
        """Record a trial."""
        add_to(self.folder / TRIALS, to_json(trial), new=not self._written)
        self._written = True


def _read(path: Path) -> bytes:
    try:
        return regular(path).read_bytes()
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error


Fresh = Callable[[str, int], Run]
"""Runs the fresh campaign of a spec in a round."""


class Search:
    """The search for values, round by round."""

    def __init__(
        self,
        run: Run,
        plan: SimulationPlan,
        settings: RepairSettings,
        begin: Callable[[Mapping[str, Any]], RepairJournal],
        *,
        open_workers: Callable[[], AbstractContextManager[Workers]],
        check: Callable[[], None] = lambda: None,
        on_trial: Callable[[Trial], None] = lambda _: None,
    ) -> None:
        """Take a campaign and the plan of its cases.

        `begin` gives the journal once there is something to repair. `check` is called after every
        trial and may raise to stop there; `on_trial` is told of it.
        """
        self._plan, self._settings, self._begin = plan, settings, begin
        self._record = {
            "cases_sha256": hashlib.sha256(_read(run.folder / OUTCOMES)).hexdigest(),
            "vut": str(plan.vut.spec),
            "vut_files": plan.vut.files,
            "parameters": to_plain(settings.ranges),
            **{name: getattr(settings, name) for name in ("cost", "trials", "rounds", "cases")},
            "seed": settings.seed,
            "versions": {**plan.versions, "optuna": version("optuna")},
        }
        self._open, self._check, self._on_trial = open_workers, check, on_trial
        self._workers: Workers | None = None
        self._ranges = {one.name: one for one in settings.ranges}
        self.today = plan.vut.values_of(settings.ranges)
        self.cases: list[Case] = [outcome.case for outcome in run.outcomes]
        self._own = len(self.cases)
        self._before: list[Outcome] = []
        """What becomes of the cases with today's values."""
        self.trials: list[Trial] = []
        self._round = 1
        self._journal: RepairJournal | None = None

    def repaired(self, fresh: Fresh, folder: Path) -> Repair:
        """Search, test and search again; return what was found, which is in a folder.

        Raises `UserError` where no case fails, and for a parameter without an effect.
        """
        rounds = list[Round]()
        failing: tuple[int, ...] = ()
        for number in range(1, self._settings.rounds + 1):
            self._round = number
            with self._opened():
                self._before += self._run(self._plan, self.cases[len(self._before) :])
                failing = failing or tuple(
                    i for i in range(self._own) if not passes(self._before[i])
                )
                if not failing:
                    raise UserError(
                        f"every case passes with {self._plan.vut.spec}: nothing is to be repaired"
                    )
                self._journal = self._journal or self._begin(self._record)
                chosen = self._search(rounds[-1].chosen if rounds else None)
            if chosen is None:
                rounds.append(Round(None))
                break
            spec = self._plan.vut.spec.with_values(chosen.values, self.today)
            campaign = fresh(str(spec), number)
            with self._opened():
                compared = self._compared(campaign)
            found = summarise(campaign.cases, campaign.levels).levels.values()
            rounds.append(Round(chosen, campaign, compared, sum(one.fmc for one in found)))
            untested = [o for o in campaign.outcomes if not o.is_tested]
            against = [o.case for o in (*spread_failures(campaign.outcomes), *untested)][
                :MOST_AGAINST
            ]
            if not against:
                break
            rng = np.random.default_rng([self._settings.seed, number, 1])
            self.cases += with_neighbours(against, rng)
        return Repair(
            folder=folder,
            vut=str(self._plan.vut.spec),
            settings=self._settings,
            today=self.today,
            failing=failing,
            cases=self._own,
            rounds=tuple(rounds),
            trials=tuple(self.trials),
        )

    @contextmanager
    def _opened(self) -> Iterator[None]:
        with self._open() as self._workers:
            yield
        self._workers = None

    def _compared(self, campaign: Run) -> Comparison:
        """Compare a fresh campaign with today's values in the same cases."""
        cases = [outcome.case for outcome in campaign.outcomes]
        today = [
            replace(before, index=after.index)
            for before, after in zip(self._run(self._plan, cases), campaign.outcomes, strict=True)
        ]
        return compare_outcomes(today, campaign, str(self._plan.vut.spec))

    def _run(self, plan: SimulationPlan, cases: Sequence[Case]) -> list[Outcome]:
        ran = evaluate(plan.for_cases(len(cases)), cases, self._workers, _outcomes_of)
        return [outcome for _, outcome in sorted(ran, key=itemgetter(0))]

    def _selected(self) -> list[int]:
        """Return the cases of a trial: what does not pass, near misses, and a share of the rest."""
        failing = [i for i, before in enumerate(self._before) if not passes(before)]
        passing = [i for i, before in enumerate(self._before) if passes(before)]
        passing.sort(key=lambda i: (self._before[i].margin or 0.0, i))
        near, rest = passing[: len(failing)], passing[len(failing) :]
        rng = np.random.default_rng([self._settings.seed, self._round])
        drawn = rng.choice(len(rest), math.ceil(SHARE * len(rest)), replace=False)
        return sorted({*failing, *near, *(rest[k] for k in drawn.tolist())})

    def _search(self, earlier: Trial | None) -> Trial | None:
        """Return the best trial of a round, with all cases; None where none helps."""
        selected = self._selected()
        first = [self.today, *([] if earlier is None else [earlier.values])]
        if earlier is None:
            first += [
                {**self.today, one.name: end}
                for one in self._settings.ranges
                for end in (one.low, one.high)
            ]
        found = [self._proposed(study, selected) for study in self._studies(first)]
        if earlier is None:
            self._check_effect(found)
        present = found[0]
        better = sorted(
            (t for t in found if t.holds), key=lambda t: (*self._aims(t), self._size(t))
        )
        for trial in better[:CONFIRMED]:
            if len(trial.fails) >= len(present.fails):
                return None
            trimmed = self._trimmed(trial, selected)
            everywhere = self._trial(trimmed.values, range(len(self.cases)), all_cases=True)
            if everywhere.holds:
                return everywhere
        return None

    def _studies(self, first: Sequence[Mapping[str, float]]) -> Iterator[optuna.Study]:
        """Give the study of optuna once for each of its trials."""
        import optuna

        optuna.logging.set_verbosity(optuna.logging.WARNING)
        # Startup trials are drawn at random: a few for each parameter.
        startup = max(10, len(first) + 4 * len(self._ranges))
        seed = self._settings.seed * 1000 + self._round
        sampler = optuna.samplers.TPESampler(seed=seed, n_startup_trials=startup, multivariate=True)
        study = optuna.create_study(directions=["minimize"] * 3, sampler=sampler)
        for values in first:
            study.enqueue_trial(dict(values))
        for _ in range(self._settings.trials):
            yield study

    def _proposed(self, study: optuna.Study, selected: Sequence[int]) -> Trial:
        """Ask for a trial, run it and tell what became of it."""
        import optuna

        asked = study.ask(
            {
                name: optuna.distributions.FloatDistribution(one.low, one.high)
                for name, one in self._ranges.items()
            }
        )
        values = {name: self._ranges[name].rounded(asked.params[name]) for name in self._ranges}
        # Today's values have all their digits.
        is_todays = all(asked.params[name] == value for name, value in self.today.items())
        trial = self._trial(self.today if is_todays else values, selected)
        if trial.refused:
            study.tell(asked, state=optuna.trial.TrialState.FAIL)
            return trial
        asked.set_constraint("broke", float(len(trial.broke)))
        study.tell(
            asked, [len(trial.fails), trial.costs_more(self._settings.cost), self._size(trial)]
        )
        return trial

    def _trial(
        self, values: Mapping[str, float], indices: Sequence[int], *, all_cases: bool = False
    ) -> Trial:
        """Return a trial that is recorded, or run it on cases and record it."""
        assert self._journal is not None, "begun before"  # noqa: S101
        wanted = Trial(self._round, dict(values), all_cases=all_cases)
        trial = self._journal.recorded(wanted)
        if trial is None:
            trial = self._ran(wanted, indices)
            self._journal.add(trial)
            self._check()
        self.trials.append(trial)
        self._on_trial(trial)
        return trial

    def _ran(self, wanted: Trial, indices: Sequence[int]) -> Trial:
        spec = self._plan.vut.spec.with_values(wanted.values, self.today)
        is_todays = wanted.values == self.today
        try:
            if is_todays:
                after = [self._before[index] for index in indices]
            else:
                vut = VutFactory(spec, self._plan.vut.options)
                cases = [self.cases[index] for index in indices]
                after = self._run(replace(self._plan, vut=vut), cases)
        except UserError as error:
            return Trial(wanted.round, wanted.values, refused=str(error))
        pairs = [(i, self._before[i], now) for i, now in zip(indices, after, strict=True)]
        both = [(old, now) for _, old, now in pairs if old.is_tested and now.is_tested]
        return Trial(
            wanted.round,
            wanted.values,
            fails=tuple(i for i, old, now in pairs if not passes(old) and not passes(now)),
            broke=tuple(i for i, old, now in pairs if passes(old) and not passes(now)),
            extra={
                cost: fmean(
                    float(now.measures.value(name) or 0.0) - float(old.measures.value(name) or 0.0)
                    for old, now in both
                )
                if both
                else 0.0
                for cost, (name, _) in MEASURED_BY.items()
            },
            differs=any(old.measures != now.measures for _, old, now in pairs),
            all_cases=wanted.all_cases,
        )

    def _check_effect(self, found: Sequence[Trial]) -> None:
        """Raise `UserError` for a parameter of which both ends change nothing."""
        for place, one in enumerate(self._settings.ranges):
            ends = found[1 + 2 * place : 3 + 2 * place]
            if not any(trial.differs or trial.refused for trial in ends):
                raise UserError(
                    f"`params` {one.name} has no effect on any case, be it {one.low:g} or "
                    f"{one.high:g}: leave it out, or name what the controller reads"
                )

    def _size(self, trial: Trial) -> float:
        return change_of(trial.values, self.today, self._settings.ranges)

    def _aims(self, trial: Trial) -> tuple[int, int]:
        """Return what is compared before the change: failures, and steps of extra cost."""
        extra = trial.costs_more(self._settings.cost)
        return len(trial.fails), math.ceil(round(extra / COST_STEP, 9))

    def _trimmed(self, best: Trial, selected: Sequence[int]) -> Trial:
        """Return a trial with values as near to today's as the choice allows, with a reserve."""
        aims, kept = self._aims(best), best

        def as_good(name: str, value: float) -> bool:
            nonlocal kept
            trial = self._trial({**kept.values, name: value}, selected)
            good = trial.holds and self._aims(trial) <= aims
            kept = trial if good else kept
            return good

        by_change = sorted(
            self._settings.ranges,
            key=lambda one: -change_of(kept.values, self.today, [one]),
        )
        for one in by_change:
            today, good = self.today[one.name], kept.values[one.name]
            if good == today:
                continue
            if as_good(one.name, today):
                continue
            bad = today
            for _ in range(BISECTIONS):
                middle = (bad + good) / 2.0
                if as_good(one.name, one.rounded(middle)):
                    good = middle
                else:
                    bad = middle
            as_good(one.name, one.rounded(good + RESERVE * (good - today)))
        return kept


def with_neighbours(cases: Sequence[Case], rng: np.random.Generator) -> list[Case]:
    """Return cases, and around each others within the radius of FMC on every axis of the pool.

    A failure is one of a region: values that let it pass alone repair nothing.
    """
    found = list(cases)
    for case in cases:
        centre = to_unit([case], case.level, case.scenario)
        offsets = rng.uniform(-RADIUS, RADIUS, (NEIGHBOURS, centre.shape[1]))
        near = np.clip(centre + offsets, 0.0, 1.0)
        found += from_unit(near, case.level, scenario=case.scenario)
    return found


def _outcomes_of(results: Episodes) -> list[Outcome]:
    """Return the outcomes of a chunk, without motions."""
    return [episode.outcome for episode in results]
