"""What a safety board asks of a campaign, answered in sentences whose numbers name their source.

The page and the JSON file show one list of topics. A number enters a sentence as a `Figure`, which
holds its value, and the file and the key that it is from; so no sentence has a number without one.
What was not run is said with the command that runs it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from merge_sumo.analysis.exposure import read_distribution
from merge_sumo.analysis.summary import LevelSummary, Summary, summarise
from merge_sumo.analysis.verdict import Verdict, judge
from merge_sumo.campaigns.store import OUTCOMES, SETTINGS, Run, failures
from merge_sumo.errors import UserError
from merge_sumo.reports.report_model import kept_truth, road_of_run
from merge_sumo.studies.counterfactuals import AVOIDANCE, read_avoidance
from merge_sumo.studies.crosscheck import CROSSCHECK, Verdicts, crosscheck_of
from merge_sumo.studies.failures_per_merge import RESULT as PER_MERGE
from merge_sumo.studies.failures_per_merge import per_merge_of
from merge_sumo.studies.probability import RESULT as PROBABILITY
from merge_sumo.studies.probability import probability_of
from merge_sumo.studies.stress import STRESS, Stress, stress_of
from merge_sumo.system.printable import printable, quoted, two_digits
from merge_sumo.values.criteria import CRITERIA
from merge_sumo.values.fmc import fmc, radius_for
from merge_sumo.values.scenario import OWN, MergeScenario, lane_of, level_name
from merge_sumo.values.score import FAILURE_SCORE, Outcome
from merge_sumo.values.severity import Severity, meanings

SLOWEST_TRAFFIC_MPS: Final = 17.0
"""Less than one car in a hundred of the traffic that a command names drives slower."""
OF_A_CAMPAIGN: Final = (
    *("vut", "levels", "scenario", "fail_when", "require"),
    *("policies_sha256", "net_sha256"),
)
"""Settings in which a study is the same as the campaign that it is of."""
Value = float | int | str


@dataclass(frozen=True, slots=True)
class Figure:
    """A number or a name in a sentence.

    Attributes:
        value: as its source has it.
        shown: as the sentence writes it.
        file: file of the run folder that it is from, or a publication.
        key: where in the file, as "levels.1.high"; lines of a JSON-lines file by what they have.
    """

    value: Value
    shown: str
    file: str
    key: str


@dataclass(frozen=True, slots=True)
class Statement:
    """A sentence, its figures, and the command that answers what it leaves open, if any."""

    text: str
    figures: tuple[Figure, ...] = ()
    command: str = ""

    @property
    def sources(self) -> list[tuple[str, list[str]]]:
        """The files of its figures, and the keys in each."""
        keys: dict[str, dict[str, None]] = {}
        for figure in self.figures:
            keys.setdefault(figure.file, {})[figure.key] = None
        return [(file, list(of_file)) for file, of_file in keys.items()]


@dataclass(frozen=True, slots=True)
class Topic:
    """A question, and the sentences that answer it.

    Attributes:
        name: by which files and links name it.
        question: the question.
        statements: the answer; the first sentence stands for it where there is room for one.
    """

    name: str
    question: str
    statements: tuple[Statement, ...]


def say(text: str, *figures: Figure, command: str = "") -> Statement:
    """Return a statement: a text with a place, "{}", for each figure."""
    return Statement(text.format(*(figure.shown for figure in figures)), figures, command)


def figure(value: Value, file: str, key: str, digits: str = "") -> Figure:
    """Return a figure; `digits` is a format, of whole numbers by default with commas."""
    if isinstance(value, str):
        return Figure(value, printable(value), file, key)
    whole = isinstance(value, int) and not digits
    return Figure(value, format(value, digits or ("," if whole else "g")), file, key)


def share(value: float, file: str, key: str) -> Figure:
    """Return a share as a figure in percent."""
    return Figure(value, _percent(value), file, key)


def _percent(value: float) -> str:
    """Return a share in percent: with a decimal as the terminal has it, or two digits if small."""
    percent = 100.0 * value
    return f"{round(percent, 1):g} %" if percent >= 10.0 else f"{two_digits(percent)} %"


def _in_1000(per_merge: float, key: str) -> Figure:
    """Return a number per merge as a figure in 1,000 merges."""
    return Figure(per_merge, two_digits(1000.0 * per_merge), PER_MERGE, key)


def _files(settings: Mapping[str, Any], name: str) -> dict[str, Any]:
    """Return the hashes of files that a record has; a record is data, and may hold anything."""
    files = settings.get(name)
    return files if isinstance(files, dict) else {}


def _as_text(text: str) -> str:
    """Return a text that `say` leaves as it is."""
    return text.replace("{", "{{").replace("}", "}}")


class BoardModel:
    """What a page for the board says of a run; `UserError` where a file is of another campaign."""

    def __init__(
        self,
        run: Run,
        *,
        summary: Summary | None = None,
    ) -> None:
        """Read the run and what studies left in its folder.

        `summary` is that of the run, where it is known.
        """
        self.run = run
        self.summary = summary or summarise(run.outcomes, run.levels, run.tolerated)
        self.verdict: Verdict = judge(run.cases)
        self.kept: dict[str, Path] = {}
        """Files of the cache that sentences name, by name."""
        self.avoidance = read_avoidance(run)
        self.per_merge = per_merge_of(run.folder)
        self.probability = probability_of(run.folder)
        self.stress = stress_of(run.folder)
        self.crosscheck = crosscheck_of(run.folder)
        if self.per_merge is not None:
            self._check(self.per_merge.campaign, run.folder / PER_MERGE)
        if self.probability is not None:
            self._check(self.probability.campaign, run.folder / PROBABILITY)

    def _check(self, settings: Mapping[str, Any], path: Path) -> None:
        for name in OF_A_CAMPAIGN:
            if settings.get(name) != self.run.settings.get(name):
                raise UserError(f"{path} is of another campaign: its {name} differs")
        for name in ("vut_files", "pov_files"):
            one, other = _files(settings, name), _files(self.run.settings, name)
            if differing := [
                file for file in one.keys() & other.keys() if one[file] != other[file]
            ]:
                raise UserError(f"{path} is of another campaign: {min(differing)} is another one")

    def topics(self) -> list[Topic]:
        """Return the topics in the order of the page."""
        found = (
            ("tested", "What was tested?", self._tested()),
            ("against", "Against whom?", self._against()),
            ("failure", "What counts as a failure?", self._failure()),
            ("found", "What was found?", self._found()),
            ("remains", "How much was searched, and what may remain?", self._remains()),
            ("often", "How often would that be on a road?", self._often()),
            ("avoidable", "Would a careful driver have avoided it?", self._avoidable()),
            ("robust", "Is it robust, or does it hang by a thread?", self._robust()),
            ("simulators", "Is it this simulator?", self._simulators()),
            ("unsaid", "What does this page not say?", self._unsaid()),
        )
        return [Topic(name, question, tuple(said)) for name, question, said in found]

    def _command(self, verb: str, further: str = "") -> str:
        return f"merge-sumo {verb} {quoted(self.run.folder)}{further}"

    def _lines(self, value: int, what: str = "") -> Figure:
        """Return a number of lines of the outcomes as a figure."""
        return figure(value, OUTCOMES, f"lines with {what}" if what else "lines")

    @property
    def _failing(self) -> str:
        """What the lines of failures have."""
        return f"score < {FAILURE_SCORE:g}" if self.run.criterion.is_papers else "margin < 0"

    # What was tested, and against whom.

    def _tested(self) -> Iterator[Statement]:
        run, settings = self.run, self.run.settings
        versions = settings.get("versions")
        known = versions if isinstance(versions, dict) else {}
        yield say(
            "The vehicle under test (VUT), {}, was simulated in {} cases of the scenario {}, with "
            "merge-sumo {} and SUMO {}.",
            figure(run.vut, SETTINGS, "vut"),
            self._lines(self.summary.cases),
            figure(run.scenario.name, SETTINGS, "scenario.name"),
            figure(str(known.get("merge-sumo")), SETTINGS, "versions.merge-sumo"),
            figure(str(known.get("libsumo")), SETTINGS, "versions.libsumo"),
        )
        yield from self._starts()
        yield from self._imperfect()
        yield say(
            "The sampler {} (seed {}) chose the cases in search of failures, so the share of "
            "failures among them is no frequency.",
            figure(str(settings.get("sampler")), SETTINGS, "sampler"),
            figure(self._seed, SETTINGS, "seed"),
        )

    @property
    def _seed(self) -> int:
        seed = self.run.settings.get("seed")
        return seed if isinstance(seed, int) else 0

    def _starts(self) -> Iterator[Statement]:
        scenario = self.run.scenario
        if not isinstance(scenario, MergeScenario):
            return
        x_m, v_mps, slow_mps = scenario.x_pov0_m, scenario.v_pov0_mps, scenario.bounds("v_vut0_mps")
        point = (
            "the merge point M" if lane_of(scenario) is None else "M, where a merge is expected,"
        )
        text = (
            f"In each, another driver starts on the mainline, {{}} to {{}} m before {point} "
            "at {} to {} m/s, and the VUT on the ramp, {} m before it"
        )
        ends = [
            *(Figure(x, f"{-x:g}", SETTINGS, "scenario.x_pov0_m") for x in reversed(x_m)),
            *(figure(v, SETTINGS, "scenario.v_pov0_mps") for v in v_mps),
            Figure(scenario.x_vut0_m, f"{-scenario.x_vut0_m:g}", SETTINGS, "scenario.x_vut0_m"),
        ]
        if slow_mps[0] == slow_mps[1]:
            ends.append(figure(slow_mps[0], SETTINGS, "scenario.v_vut0_mps"))
            yield say(f"{text} at {{}} m/s. All such starts are the pool.", *ends)
        else:
            ends += [figure(v, SETTINGS, "scenario.v_vut0_mps") for v in slow_mps]
            yield say(f"{text} at {{}} to {{}} m/s. All such starts are the pool.", *ends)

    def _imperfect(self) -> Iterator[Statement]:
        """What sensors and actuator of the VUT were given; a range is a coordinate of the pool."""
        scenario = self.run.scenario
        for known, what, key in (
            (scenario.sense, "The VUT senses other cars imperfectly", "scenario.sense"),
            (scenario.act, "The VUT obeys its controller imperfectly", "scenario.act"),
        ):
            if not known.is_perfect:
                wide = "; a range is part of the pool" if known.ranged else ""
                shown = known.text.replace(",", ", ").replace("..", " to ").replace("=", " ")
                yield say(f"{what}: {{}}{wide}.", Figure(known.text, shown, SETTINGS, key))

    def _against(self) -> Iterator[Statement]:
        for level, found in self.summary.levels.items():
            cases = self._lines(found.cases, f"level = {level}")
            if level == OWN:
                pov = figure(self.run.pov, SETTINGS, "pov")
                yield say("Level own, {} cases: the other driver is {}.", cases, pov)
                continue
            about = self.run.scenario.level_about.get(level, "drives as the scenario says")
            yield say(f"Level {level}, {{}} cases: the other driver {_as_text(about)}.", cases)
        policies = self.run.settings.get("policies")
        if {1, 2} & set(self.summary.levels):
            library = "the default library" if policies is None else f"the library {policies}"
            yield say(
                "Drivers of levels 1 and 2 are trained networks, {}. They are models of driving "
                "and no recordings of people.",
                Figure(str(policies), printable(library), SETTINGS, "policies"),
            )

    def _failure(self) -> Iterator[Statement]:
        criterion, scenario = self.run.criterion, self.run.scenario
        is_named = criterion.text in CRITERIA
        yield say(
            "What fails: {}.",
            Figure(
                criterion.text,
                scenario.said(CRITERIA[criterion.text].about if is_named else criterion.words),
                SETTINGS,
                "fail_when" if criterion.require is None else "require",
            ),
        )
        meaning = "; ".join(f"{word}: {means}" for word, means in meanings(scenario).items())
        yield Statement(f"Severity, whatever counts as a failure: {meaning}.")

    # What was found.

    def _found(self) -> Iterator[Statement]:
        verdict, failing = self.verdict, self._failing
        if not verdict.tested:
            yield say("Nothing was tested: {} cases ran.", self._lines(verdict.cases))
        elif not verdict.failures:
            tested = self._lines(verdict.tested, "neither error nor timeout")
            yield say("None of {} tested cases fails.", tested)
        else:
            yield say(
                "{} of {} cases fail; in {} of them bodies touch.",
                self._lines(verdict.failures, failing),
                self._lines(verdict.cases),
                self._lines(verdict.contacts, f"{failing}, severity = contact"),
            )
        passing = sum(
            not o.failed and o.measures.severity == Severity.CONTACT for o in self.run.cases
        )
        if passing:
            yield say(
                "In {} other cases bodies touch, too: they are no failures by what counts as one "
                "here. With --fail-when unsafe they are.",
                self._lines(passing, "severity = contact, not failing"),
            )
        if verdict.errors or verdict.timeouts:
            yield say(
                "{} cases ended in an error and {} by the timeout: they have no verdict.",
                self._lines(verdict.errors, "end = VUT_ERROR or SIM_ERROR"),
                self._lines(verdict.timeouts, "end = TIMEOUT, not failing"),
            )
        for level, found in self.summary.levels.items():
            yield self._found_at(level, found)
        worst = failures(self.run.cases)
        if worst:
            yield self._worst(worst[0])

    def _worst(self, outcome: Outcome) -> Statement:
        index, found = outcome.index, outcome.measures
        text = "The worst case is {}"
        figures = [figure(index, OUTCOMES, "index of the failing line with the lowest score")]
        if found.impact_speed_mps is not None:
            text += ": bodies touch at a relative speed of {} m/s"
            key = f"line {index}: impact_speed_mps"
            figures.append(figure(found.impact_speed_mps, OUTCOMES, key, ".1f"))
        elif found.dx_m is not None and isinstance(self.run.scenario, MergeScenario):
            text += f": front bumpers {{}} m apart at {self.run.scenario.place}"
            figures.append(figure(abs(found.dx_m), OUTCOMES, f"line {index}: dx_m", ".1f"))
        return say(f"{text}.", *figures, command=self._command("replay", f" {index} --gui"))

    def _found_at(self, level: int, found: LevelSummary) -> Statement:
        at = f"level = {level}"
        counts = (
            self._lines(found.failures, f"{at}, {self._failing}"),
            self._lines(found.cases, at),
        )
        text = f"Level {level_name(level)}: {{}} of {{}} cases fail"
        if not found.failures:
            return say(f"{text}.", *counts)
        regions = figure(found.regions, OUTCOMES, f"regions of the failing lines with {at}")
        some = "region" if found.regions == 1 else "separate regions"
        return say(f"{text}, in {{}} {some} of starts.", *counts, regions)

    # What may remain.

    def _remains(self) -> Iterator[Statement]:
        for level, found in self.summary.levels.items():
            yield from self._searched(level, found)
        yield from self._chance()

    def _searched(self, level: int, found: LevelSummary) -> Iterator[Statement]:
        at, dims = f"level = {level}", len(self.run.scenario.dimensions(level))
        if found.failures:
            yield say(
                f"Level {level_name(level)}: the volume within {{}} of a failure (FMC; the pool is "
                "1) is {}.",
                figure(radius_for(dims), OUTCOMES, "radius of the FMC"),
                figure(found.fmc, OUTCOMES, f"failing lines with {at}: starts", ".4f"),
            )
        kept = kept_truth(self.run, road_of_run(self.run), level)
        if kept is None:
            return
        truth, path = kept
        self.kept[path.name] = path
        failing, key = truth.failures, f"points with score < {FAILURE_SCORE:g}"
        text = f"Level {level_name(level)}, for comparison: of {{}} uniform cases {{}} fail"
        figures = [figure(len(truth.points), path.name, "points")]
        figures.append(figure(len(failing), path.name, key))
        if len(failing):
            text += ", FMC {}"
            figures.append(figure(fmc(failing), path.name, key, ".4f"))
        yield say(f"{text}.", *figures)

    def _chance(self) -> Iterator[Statement]:
        known = self.probability
        if known is None:
            return
        uniform = read_distribution(None, self.run.levels, self.run.scenario).record()
        given = (
            "if all starts and levels were alike"
            if known.distribution == uniform
            else ("under the stated distribution of starts and levels")
        )
        yield say(
            f"A case of the pool fails with a probability of {{}} ({{}} to {{}}, {{}} confidence) "
            f"{given}: {{}} fresh cases.",
            share(known.probability, PROBABILITY, "probability"),
            share(known.low, PROBABILITY, "low"),
            share(known.high, PROBABILITY, "high"),
            share(known.confidence, PROBABILITY, "confidence"),
            figure(known.cases, PROBABILITY, "cases"),
        )

    def _often(self) -> Iterator[Statement]:
        known = self.per_merge
        if not isinstance(self.run.scenario, MergeScenario):
            yield Statement("Not known: no traffic is published for this kind of scenario.")
            return
        if self.run.scenario.vehicles > 2:
            yield Statement(
                "Not known: a traffic has its own headways, and so has a scenario with a queue."
            )
            return
        if known is None:
            slow = self.run.scenario.bounds("v_pov0_mps")[1] < SLOWEST_TRAFFIC_MPS
            traffic = "FILE" if slow else "exid-5"
            yield Statement(
                "Not run: with how many mainline cars a merge fails in traffic of published "
                "density and speeds.",
                command=self._command("failures-per-merge", f" --traffic {traffic}"),
            )
            return
        density = known.traffic.density_veh_per_km or 0.0
        least, most = known.outside
        ends = dict.fromkeys((_percent(least), _percent(most)))
        yield say(
            "In 1,000 merges in the traffic {} ({} cars/km), failures with {} to {} cars of the "
            "mainline are expected, whatever the mixture of levels is ({} confidence); so at most "
            "{} of 1,000 merges fail with a counted car. {} of the traffic is not counted, as its "
            "speed is outside the pool.",
            figure(known.traffic.name, PER_MERGE, "traffic.name"),
            figure(density, PER_MERGE, "traffic.density_veh_per_km"),
            _in_1000(known.low, "low"),
            _in_1000(known.high, "high"),
            share(known.confidence, PER_MERGE, "confidence"),
            _in_1000(known.high, "high"),
            Figure(most, " to ".join(ends), PER_MERGE, "outside"),
        )
        parts, figures = [], []
        for level, one in known.levels.items():
            parts.append(f"{{}} to {{}} at level {level_name(int(level))}")
            figures.append(_in_1000(one.low, f"levels.{level}.low"))
            figures.append(_in_1000(one.high, f"levels.{level}.high"))
        yield say(f"If all drivers were of one level: {'; '.join(parts)}.", *figures)
        counted = printable(known.counted)
        yield say(
            "Source of the traffic: {}. {}.",
            figure(known.traffic.source, PER_MERGE, "traffic.source"),
            Figure(known.counted, f"{counted[:1].upper()}{counted[1:]}", PER_MERGE, "counted"),
        )

    def _avoidable(self) -> Iterator[Statement]:
        known = list(self.avoidance.values())
        if not self.verdict.failures:
            yield Statement("No failure is there to avoid.")
        elif not known:
            yield Statement("Not known: the failures were not run again with careful drivers.")
        else:
            careful, pov = sum(o.by_careful for o in known), sum(o.pov_careful for o in known)
            yield say(
                "A careful and competent driver in the place of the VUT avoids {} of {} failures; "
                "a careful driver in the place of the other one avoids {}.",
                figure(careful, AVOIDANCE, "lines with careful in avoided_by"),
                figure(len(known), AVOIDANCE, "lines"),
                figure(pov, AVOIDANCE, "lines with pov_careful"),
            )

    # Robustness and other simulators.

    def _robust(self) -> Iterator[Statement]:
        known = self.stress
        if known is None:
            yield Statement(
                "Not run: whether failures remain with an actuator lag, noise of the start, a "
                "smaller step and a longer car.",
                command=self._command("stress"),
            )
            return
        if not known.failures:
            yield say(
                "No case fails; {} cases ran in all {} runs of the stress test.",
                figure(known.cases, STRESS, "cases"),
                figure(known.runs, STRESS, "rungs.runs"),
            )
        else:
            yield self._fail_throughout(known)
            if len(known.robust) < len(known.failures):
                yield Statement(
                    "A narrow region of failures has few that remain, although others near them "
                    "fail: a campaign in a scenario with the change shows how large it then is."
                )
        ran = [(rung, flips) for rung in known.rungs if (flips := known.share(rung)) is not None]
        if ran:
            parts, figures = [], []
            for rung, flips in ran:
                key = f"rungs.{rung.name}"
                parts.append("{} ({})")
                figures.append(share(flips, STRESS, f"{key}.runs"))
                figures.append(figure(rung.about, STRESS, f"{key}.about"))
            yield say(f"Share of verdicts that flip: {'; '.join(parts)}.", *figures)
        for rung in known.rungs:
            if rung.skipped:
                yield say(
                    "Not run: {} ({}).",
                    figure(rung.about, STRESS, f"rungs.{rung.name}.about"),
                    figure(rung.skipped, STRESS, f"rungs.{rung.name}.skipped"),
                )

    def _fail_throughout(self, known: Stress) -> Statement:
        return say(
            "{} of {} failures remain failures in all {} runs of the stress test, each with one "
            "thing changed.",
            figure(len(known.robust), STRESS, "failures in no run's passes or without_verdict"),
            figure(len(known.failures), STRESS, "failures"),
            figure(known.runs, STRESS, "rungs.runs"),
        )

    def _simulators(self) -> Iterator[Statement]:
        known = self.crosscheck
        if known is None:
            yield Statement(
                "Not run: whether another simulator agrees on motion and verdicts.",
                command=self._command("crosscheck"),
            )
            return
        if known.verdicts is None:
            yield say(
                "{} cannot host these drivers: {}.",
                figure(known.peer, CROSSCHECK, "peer"),
                figure(known.why_no_verdicts, CROSSCHECK, "why_no_verdicts"),
            )
        else:
            yield from self._same_verdicts(known.peer, known.verdicts)
        yield say(
            "The recorded motion of {} cases differs from that of {} by {} m at most.",
            figure(known.motion.cases, CROSSCHECK, "motion.cases"),
            figure(known.peer, CROSSCHECK, "peer"),
            figure(known.motion.largest_m, CROSSCHECK, "motion.largest_m", ".1g"),
        )
        yield Statement(
            "That is about hosting, motion and scoring. It says nothing of people, nor of the "
            "dynamics of real vehicles."
        )

    def _same_verdicts(self, peer: str, verdicts: Verdicts) -> Iterator[Statement]:
        cases = figure(verdicts.cases, CROSSCHECK, "verdicts.recorded + verdicts.fresh")
        yield say(
            "In another simulator, {}, with the same drivers, criterion and equations of motion, "
            "{} of {} cases end as in SUMO; {} of them fail in SUMO.",
            figure(peer, CROSSCHECK, "peer"),
            figure(verdicts.same, CROSSCHECK, "verdicts.recorded + verdicts.fresh - differences"),
            cases,
            figure(verdicts.failures, CROSSCHECK, "verdicts.failures"),
        )
        if verdicts.lowest_only:
            yield Statement("These are the cases of the campaign with the lowest scores.")
        if verdicts.differences:
            explained = sum(one.is_explained for one in verdicts.differences)
            yield say(
                "Of the {} others {} have a reason that is none of the simulators.",
                figure(len(verdicts.differences), CROSSCHECK, "verdicts.differences"),
                figure(explained, CROSSCHECK, "verdicts.differences: reason"),
            )

    def _unsaid(self) -> Sequence[Statement]:
        return [Statement(text) for text in UNSAID]


UNSAID: Final = (
    "No rate of crashes per kilometre or per year: a failure as defined above is no crash on a "
    "road.",
    "No proof of safety: a search shows failures and cannot show that there are none.",
    "Nothing of tyres, steering, sensors or software timing beyond the equations of motion, except "
    "where this page says so.",
    "Nothing of other roads, weather, or more cars than the scenario has.",
    "Nothing of how many people drive like a level: the shares of levels are unknown.",
)
