"""The folder of a campaign, as any process reads it; `Journal` (`journal.py`) writes it.

campaign.json             every resolved setting, versions, hashes of net and controllers
outcomes.jsonl            one line per case, in order, synced after every batch
trajectories/00007.npz    the motion of every case of a batch

against/                  the same of the earlier version, where a campaign is against one
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, fields, replace
from itertools import count
from pathlib import Path
from typing import Annotated, Any, Final, TypeVar

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from merge_sumo.config import MOST_CASES, Search
from merge_sumo.errors import UserError, explained
from merge_sumo.files import regular
from merge_sumo.metrics.criterion import PAPER_CRITERION, Criterion
from merge_sumo.metrics.fmc import fmc, regions
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.metrics.summary import RunsOfCase, failing_cases, one_per_case
from merge_sumo.printable import counted, printable
from merge_sumo.records import RecordError, convert, decode, read_arrays
from merge_sumo.scenario.case import FloatArray, to_unit
from merge_sumo.scenario.scenario import ALL_LEVELS, Scenario
from merge_sumo.scenario.signals import SignalRuns, Signals, from_runs
from merge_sumo.scenario.trajectory import Trajectory

SETTINGS = "campaign.json"
OUTCOMES = "outcomes.jsonl"
TRAJECTORIES = "trajectories"
AGAINST = "against"
"""Folder of the earlier version, and the key of `campaign.json` that names it."""
NAME_CHARACTERS = 300
"""Maximum length of the name of a VUT in a sentence."""
RAN_AGAIN = "ran_again"
"""Key of `campaign.json`: number of cases that ran again after the death of a process."""
IN_VAIN = "in_vain"
"""Key of `campaign.json`: for each command of the VUT without effect, the number of cases."""
TALLIES = (RAN_AGAIN, IN_VAIN)
"""Keys of `campaign.json` that count as cases end, and are not settings."""
FILES = ("vut_files", "pov_files")
"""Keys of `campaign.json`: files that the VUT and the user's own POV have loaded."""
FARTHEST = 1e9
"""Bound of each position, speed and acceleration in a trajectory, in m, m/s and m/s2."""
WINDOW: Final = 100
"""Cases of all levels together whose new coverage decides whether a search has converged."""
MIN_GROWTH: Final = 0.01
"""Relative growth of the coverage over the window below which a search has converged."""


class NoTrajectoryError(UserError):
    """A trajectory is missing, or its file cannot be read."""


ControllerText = Annotated[
    str, Meta(max_length=10_000, description="a text of at most 10,000 characters")
]
"""The name of a controller, which pages and tables repeat."""


@dataclass(frozen=True, kw_only=True)
class SharedSettings(Search):
    """The settings of a campaign that whoever reads its folder needs, too."""

    vut: ControllerText
    levels: tuple[Annotated[int, Meta(ge=min(ALL_LEVELS), le=max(ALL_LEVELS))], ...] = ()
    cases: int = MOST_CASES
    pov: ControllerText | None = None
    against: ControllerText | None = None
    fail_when: str = PAPER_CRITERION.fail_when
    require: str | None = None


@dataclass(frozen=True, kw_only=True)
class RecordedSettings(SharedSettings):
    """The part of `campaign.json` that a reader needs; a missing key has its default."""

    ran_again: int = 0
    in_vain: dict[str, int] = field(default_factory=dict)
    net_sha256: str | None = None
    vut_files: dict[str, str] | None = None
    pov_files: dict[str, str] | None = None


class RecordedCampaign:
    """A finished or interrupted campaign, as its folder holds it.

    Attributes:
        folder: the folder.
        record: what `campaign.json` says, with all that a later run compares.
        settings: the same, as far as a reader needs it.
        scenario: the scenario.
        criterion: what counts as a failure.
        outcomes: the outcomes, in order.
        torn: whether the last line of them was torn, and its case left out.

    Example:
        run = RecordedCampaign(Path("runs/design2"))
        worst = failures(run.cases)[0]
        motion = run.trajectory(worst.index).motion
    """

    def __init__(self, folder: Path) -> None:
        """Read settings and outcomes.

        Args:
            folder: the folder.

        Raises:
            UserError: the folder is not a campaign, a line of it cannot be read, or something is
                not as it was written.
        """
        self._take(folder, read_settings(folder), folder / SETTINGS)
        self.criterion = Criterion(self.settings.fail_when, self.settings.require)
        self._read()

    def _take(self, folder: Path, record: dict[str, Any], place: Path) -> None:
        """Take settings that are recorded at a place."""
        self.folder, self.record = folder, record
        self.scenario = recorded_scenario(record, place)
        self._batches: dict[int, dict[int, FloatArray]] = {}
        self._signals: dict[int, Signals] = {}
        """By index, of the batches that were read."""
        names = {field.name for field in fields(RecordedSettings)}
        known = {name: value for name, value in record.items() if name in names}
        with explained(f"{place} does not describe a campaign"):
            self.settings = convert(known, RecordedSettings)

    def _read(self) -> None:
        path = self.folder / OUTCOMES
        with _reading(self.folder):
            text = regular(path).read_bytes()
        self.outcomes, self.torn = read_outcomes(text, str(path), self.scenario)
        for outcome in self.outcomes:
            needs_margin = not (self.criterion.is_of_paper or outcome.measures.end.is_error)
            if needs_margin == outcome.is_by_score and not self.criterion.uses_score:
                raise UserError(
                    f"the margin of case {outcome.index} in {path} does not follow the criterion "
                    f"in {SETTINGS}, {self.criterion.as_written}"
                )

    @property
    def levels(self) -> list[int]:
        """The POV levels."""
        return list(self.settings.levels)

    @property
    def tolerated(self) -> float:
        """The share of its runs in which a case may fail."""
        return self.settings.tolerated

    @property
    def cases(self) -> list[Outcome]:
        """The run that stands for each case (`one_per_case`): all outcomes without repeats."""
        return one_per_case(self.outcomes, self.tolerated)

    @property
    def vut(self) -> str:
        """The name of the VUT, fit to be shown anywhere: it may be a stranger's."""
        return printable(self.settings.vut[:NAME_CHARACTERS])

    @property
    def pov(self) -> str:
        """The name of a POV of the tester's own, fit to be shown anywhere."""
        return printable(str(self.settings.pov)[:NAME_CHARACTERS])

    @property
    def converged(self) -> bool:
        """Whether the search ended before its number of cases, as little new was found."""
        may_stop = self.settings.stop_when_converged and len(self.outcomes) < self.settings.cases
        return may_stop and has_converged(self.outcomes, self.tolerated)

    @property
    def interruption(self) -> str:
        """A sentence on a campaign that has fewer cases than its settings; empty for others."""
        fewer = len(self.outcomes) < self.settings.cases and not self.settings.stop_when_converged
        if not (self.torn or fewer):
            return ""
        torn = f"; the last line of {OUTCOMES} is incomplete and not counted" if self.torn else ""
        return f"This campaign was interrupted; the results cover the finished cases{torn}."

    @property
    def ran_again_in_words(self) -> str:
        """A sentence on the number of cases that ran again."""
        return (
            f"{counted(self.settings.ran_again, 'case')} ran again after a process was killed or "
            "stopped; the recorded outcome is the last one."
        )

    def outcome(self, index: int) -> Outcome:
        """Return the outcome of a case.

        Args:
            index: index of the case.

        Raises:
            UserError: the campaign has no such case.
        """
        if not 0 <= index < len(self.outcomes):
            raise UserError(
                f"{self.folder} has no case {index}: it has cases 0 to {len(self.outcomes) - 1}"
            )
        return self.outcomes[index]

    def trajectory(self, index: int) -> Trajectory:
        """Return the trajectory of a case.

        Args:
            index: index of the case.

        Raises:
            NoTrajectoryError: it is missing or unreadable.
            UserError: it is not a motion.
        """
        outcome = self.outcome(index)
        whole = self._batch(outcome.batch).get(index)
        if whole is None:
            path = batch_file(self.folder, outcome.batch)
            raise NoTrajectoryError(f"{path} has no trajectory of case {index}")
        return outcome.trajectory(whole, self._signals.get(index))

    def trajectories(self, indices: Iterable[int]) -> dict[int, Trajectory]:
        """Return the trajectories of cases by index, without those that are lost.

        Args:
            indices: indices of cases.

        Raises:
            UserError: as of `trajectory`.
        """
        known = {}
        for index in indices:
            with suppress(NoTrajectoryError):
                known[index] = self.trajectory(index)
        return known

    def episodes(self) -> list[Episode]:
        """Return all episodes in order, with those of the earlier version, where there is one.

        Raises:
            UserError: as of `trajectory` and `read_earlier`.
        """
        earlier = self.read_earlier()
        episodes = []
        for outcome in self.outcomes:
            episode = Episode(outcome, self.trajectory(outcome.index))
            if earlier is not None:
                other = earlier.outcomes[outcome.index]
                other_episode = Episode(other, earlier.trajectory(other.index))
                episode = replace(episode, earlier=other_episode)
            episodes.append(episode)
        return episodes

    def read_earlier(self) -> RecordedCampaign | None:
        """Return the run of the version that this campaign is against; None without one.

        Of a campaign that was stopped it may have more cases.

        Raises:
            UserError: it is missing, or has other cases.
        """
        if self.settings.against is None:
            return None
        earlier = RecordedCampaign(self.folder / AGAINST)
        cases = [outcome.case for outcome in self.outcomes]
        if [outcome.case for outcome in earlier.outcomes[: len(cases)]] != cases:
            raise UserError(
                f"{earlier.folder} and {self.folder} have different cases: restore both from a "
                "copy, or run the campaign again"
            )
        return earlier

    def whole_batches(self) -> int:
        """Return the number of outcomes in complete batches; only the last may not be complete.

        The trajectories are written first: a batch is complete when it has an outcome for each.
        """
        if not self.outcomes:
            return 0
        last = self.outcomes[-1].batch
        indices = [outcome.index for outcome in self.outcomes if outcome.batch == last]
        try:
            complete = sorted(self._batch(last)) == indices
        except NoTrajectoryError:
            complete = False
        return len(self.outcomes) if complete else indices[0]

    def _batch(self, batch: int) -> dict[int, FloatArray]:
        """Return the motion of the cases of a batch by index."""
        if batch not in self._batches:
            path = batch_file(self.folder, batch)
            try:
                arrays = read_arrays(path)
            except RecordError as error:
                raise NoTrajectoryError(
                    f"cannot read the trajectories in {path}: {error}"
                ) from error
            try:
                motion = _motion_by_case(self.scenario.vehicles, arrays)
                if "signals" in arrays:
                    self._signals |= _signals_by_case(arrays["signals"], motion)
                self._batches[batch] = motion
            except (KeyError, ValueError, TypeError, UserError) as error:
                raise UserError(f"{path} is damaged: {error}; restore it from a copy") from error
        return self._batches[batch]


def read_settings(folder: Path) -> dict[str, Any]:
    """Return the content of `campaign.json`.

    Args:
        folder: folder of a campaign.

    Raises:
        UserError: it is not that of a campaign.
    """
    path = folder / SETTINGS
    with _reading(folder), explained(f"{path} does not describe a campaign"):
        settings: dict[str, Any] = decode(regular(path).read_bytes(), dict[str, Any])
    return settings


def recorded_scenario(settings: Mapping[str, Any], path: Path) -> Scenario:
    """Return the scenario of a campaign, the paper's where it names none.

    Args:
        settings: content of `campaign.json`.
        path: its path, for messages.

    Raises:
        UserError: the scenario is not one.
    """
    with explained(f"{path} has no scenario"):
        return convert(settings.get("scenario", {}), Scenario)


def read_outcomes(text: bytes, name: str, scenario: Scenario) -> tuple[list[Outcome], bool]:
    """Return the outcomes in the bytes of an `outcomes.jsonl`, and whether the last was torn.

    A last line without its end was being written when the campaign stopped: it is dropped. Any
    other line that is not the outcome of its place is an error that names the line.

    Args:
        text: the bytes.
        name: what messages call the file.
        scenario: the scenario of the campaign.

    Raises:
        UserError: a line that ends is not the outcome of its place.
    """
    outcomes: list[Outcome] = []
    *lines, rest = text.split(b"\n")
    for number, line in enumerate(lines, start=1):
        with explained(f"line {number} of {name} is not the outcome of case {number - 1}"):
            outcome = Outcome.from_json(line, scenario)
            if outcome.index != number - 1:
                raise UserError(f"index is {outcome.index}")
        outcomes.append(outcome)
    return outcomes, bool(rest)


def failures(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Return the failing outcomes, the worst first.

    Args:
        outcomes: outcomes of any order.
    """
    failing = [outcome for outcome in outcomes if outcome.failed]
    return sorted(failing, key=lambda outcome: (outcome.margin, outcome.index))


Judged = TypeVar("Judged", Outcome, RunsOfCase)


def _by_level(outcomes: Iterable[Judged]) -> dict[int, tuple[list[Judged], FloatArray]]:
    """Return outcomes by level, with their cases as points of its unit cube, (n, d)."""
    groups: defaultdict[int, list[Judged]] = defaultdict(list)
    for outcome in outcomes:
        groups[outcome.case.level].append(outcome)
    found = {}
    for level, group in groups.items():
        cases = [outcome.case for outcome in group]
        found[level] = group, to_unit(cases, level, cases[0].scenario)
    return found


def regions_of(outcomes: Iterable[Outcome]) -> dict[int, int]:
    """Return the region (`fmc.regions`) of each failure within its level, by index of the case.

    Args:
        outcomes: outcomes of one scenario.
    """
    region: dict[int, int] = {}
    for group, points in _by_level(failures(outcomes)).values():
        for outcome, number in zip(group, regions(points).tolist(), strict=True):
            region[outcome.index] = number
    return region


def spread_failures(outcomes: Iterable[Outcome]) -> list[Outcome]:
    """Return the failing outcomes: the worst of every region, then the second of each, ...

    Args:
        outcomes: outcomes of one scenario.
    """
    worst_first = failures(outcomes)
    region = regions_of(worst_first)
    turns: defaultdict[tuple[int, int], count[int]] = defaultdict(count)

    def turn(outcome: Outcome) -> int:
        return next(turns[outcome.case.level, region[outcome.index]])

    return sorted(worst_first, key=turn)


def has_converged(outcomes: Sequence[Outcome], tolerated: float = 0.0) -> bool:
    """Return whether the last cases added little to the coverage of all levels together.

    A search without a failure continues. A region of failures without a case near it is in no
    coverage: the rule ends a search early, and does not show that all failures were found.

    Args:
        outcomes: the outcomes, in the order of their index. They alone decide, so a resumed
            campaign ends where it would have ended.
        tolerated: the share of its runs in which a case may fail.
    """
    before = _coverage(outcomes[:-WINDOW], tolerated)
    return _coverage(outcomes, tolerated) < (1.0 + MIN_GROWTH) * before


def _coverage(outcomes: Sequence[Outcome], tolerated: float) -> float:
    """Return the sum of the failure mode coverage of all levels."""
    by_level = _by_level(failing_cases(outcomes, tolerated))
    return sum(fmc(points) for _, points in by_level.values())


def batch_file(folder: Path, batch: int) -> Path:
    """Return the path of the trajectories of a batch.

    Args:
        folder: folder of the campaign.
        batch: number of the batch.
    """
    return folder / TRAJECTORIES / f"{batch:05d}.npz"


@contextmanager
def _reading(folder: Path) -> Iterator[None]:
    """Within `with`, a file that cannot be read is a `UserError` on its folder."""
    try:
        yield
    except OSError as error:
        raise UserError(
            f"{folder} is not a run folder: cannot read {error.filename} ({error.strerror}); name "
            "a folder that `merge-sumo campaign` wrote"
        ) from error


def _motion_by_case(vehicles: int, arrays: Mapping[str, NDArray[Any]]) -> dict[int, FloatArray]:
    """Return the motion of each case, (T + 1, A, 3), from the arrays of a batch.

    Raises KeyError, ValueError or TypeError where they do not fit each other.
    """
    index, rows, motion = arrays["index"], arrays["rows"], arrays["motion"]
    if motion.dtype != np.float64 or motion.ndim != 2 or motion.shape[1] != 3 * vehicles:
        raise ValueError(f"the motion is {motion.dtype} of shape {motion.shape}")
    if not (np.abs(motion) < FARTHEST).all():
        raise ValueError("the motion has numbers that are too large or not finite")
    within = rows.dtype.kind == "i" and ((rows >= 1) & (rows <= len(motion))).all()
    if not within or rows.ndim != 1 or rows.sum() != len(motion):
        raise ValueError("the rows of the cases do not match the motion")
    parts = np.split(motion.reshape(-1, vehicles, 3), np.cumsum(rows)[:-1])
    return dict(zip(index.tolist(), parts, strict=True))


def _signals_by_case(
    text: NDArray[np.uint8], motion: Mapping[int, FloatArray]
) -> dict[int, Signals]:
    """Return the signals of each case; ValueError or TypeError where they do not fit the motion."""
    if text.dtype != np.uint8 or text.ndim != 1:
        raise ValueError(f"the signals are {text.dtype} of shape {text.shape}")
    runs = decode(text.tobytes(), dict[str, SignalRuns])
    return {int(index): from_runs(of, len(motion[int(index)])) for index, of in runs.items()}
