"""A recorded campaign as studies of it need it, and the files that they leave in its folder."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from numbers import Integral
from pathlib import Path
from typing import Generic, TypeVar

from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings, same_pov
from merge_sumo.errors import UserError, notice
from merge_sumo.files import check_generated, files_now, replace_own
from merge_sumo.metrics.outcome import Episode
from merge_sumo.printable import printable
from merge_sumo.records import Record, read_indexed, read_record, to_json
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import level_name
from merge_sumo.simulation.evaluate import evaluate
from merge_sumo.simulation.plan import SimulationPlan
from merge_sumo.workers import Workers

R = TypeVar("R", bound=Record)


@dataclass(frozen=True, slots=True)
class StudyFile(Generic[R]):
    """A file of a campaign: JSON with one record, or a line for each of some failures.

    Example:
        shares = SHARES.read(run.folder)

    Attributes:
        name: name of the file.
        kind: type of the record, or of a line, which has an `index`.
    """

    name: str
    kind: type[R]

    @property
    def _mark(self) -> bytes:
        """The name of the first field, which is in every file of the kind."""
        return f'"{self.kind.__struct_fields__[0]}"'.encode()

    def check(self, folder: Path) -> None:
        """Check that a study may write the file.

        Args:
            folder: folder of the campaign.

        Raises:
            UserError: where a file of this name was not created by merge-sumo.
        """
        check_generated(folder / self.name, self._mark)

    def read(self, folder: Path) -> R | None:
        """Read the record.

        Args:
            folder: folder of the campaign.

        Returns:
            The record; None without the file.

        Raises:
            UserError: where the file is not as it was written.
        """
        return read_record(folder / self.name, self.kind)

    def write(self, folder: Path, record: R) -> None:
        """Write the record, in the place of an older one.

        Args:
            folder: folder of the campaign.
            record: the record.
        """
        replace_own(folder / self.name, to_json(record, indent=1), self._mark)

    def read_lines(self, run: RecordedCampaign) -> list[R]:
        """Read the lines.

        Args:
            run: the campaign.

        Returns:
            The lines in their order; an empty list without the file.

        Raises:
            UserError: for a line that is not of a failure of the campaign.
        """
        failing = {outcome.index for outcome in run.outcomes if outcome.failed}
        return read_indexed(run.folder / self.name, self.kind, failing)

    def write_lines(self, folder: Path, lines: Iterable[R]) -> None:
        """Write lines, in the place of older ones.

        Args:
            folder: folder of the campaign.
            lines: the lines, in their order.
        """
        replace_own(folder / self.name, b"".join(map(to_json, lines)), self._mark)


T = TypeVar("T")

OnPart = Callable[[str, int, int, str, str], None]
"""Called with the progress of a part of a study: title, items done, all items, unit, note."""


def check_least(options: object, **least: int) -> None:
    """Check options that are whole numbers.

    Args:
        options: options of a verb; None for one of them is its default.
        least: the least value of an option, by its name.

    Raises:
        UserError: for an option that is less, or no whole number.
    """
    for name, number in least.items():
        value = getattr(options, name)
        if value is not None and (not isinstance(value, Integral) or value < number):
            raise UserError(f"`{name}` is {value!r}: it must be a whole number, {number} or more")


def end_of(episode: Episode) -> tuple[bool, bool, bool]:
    """Return whether a case failed, has a verdict, and ran in SUMO.

    Args:
        episode: the episode of the case.
    """
    return episode.outcome.failed, episode.outcome.is_tested, episode.in_sumo


@dataclass(frozen=True, slots=True)
class RunStudy:
    """A recorded campaign, and how a study runs cases of it.

    Example:
        study = RunStudy(run, settings, settings.load_plan())
        margins = study.simulate(study.plan, cases, margin_of)

    Attributes:
        run: the campaign.
        settings: those of the campaign, except for policies that are elsewhere and how a VUT is
            hosted.
        plan: that of the settings, with the engine of the study.
        workers: where cases run, by default in this process; no result depends on them.
        on_cases: called with the number of cases that have just ended.
    """

    run: RecordedCampaign
    settings: CampaignSettings
    plan: SimulationPlan
    workers: Workers = field(default_factory=Workers)
    on_cases: Callable[[int], None] = lambda _: None

    def simulate(
        self, plan: SimulationPlan, cases: Sequence[Case], keep: Callable[[Episode], T]
    ) -> list[T]:
        """Run cases, and count them as ended.

        Args:
            plan: that of the study, or with changes.
            cases: cases of the plan's scenario.
            keep: returns the part of an episode that is kept; a function of a module.

        Returns:
            The kept part of each episode, in the order of the cases.
        """
        results = []
        for result in evaluate(plan, cases, self.workers, keep):
            results.append(result)
            self.on_cases(1)
        return results

    def check_same_system(self, *, may_change: bool = False) -> None:
        """Check that net and POVs are those of the campaign.

        Args:
            may_change: whether the controller may have changed; otherwise a change is a `Notice`.

        Raises:
            UserError: where the campaign had another net or other POVs.
        """
        run, road, now = self.run, self.plan.road, self.settings.to_record(self.plan)
        if run.settings.net_sha256 not in (None, road.sha256):
            raise UserError(
                f"{road.path} is not the net on which {run.folder} ran: restore that net"
            )
        for level in self.settings.levels:
            if not same_pov(run.record, now, level):
                raise UserError(
                    f"{run.folder} ran against another POV of level {level_name(level)}: set "
                    "`policies` or `pov` as in that campaign"
                )
        if not may_change:
            notice_changes(run, self.plan)


def notice_changes(run: RecordedCampaign, plan: SimulationPlan) -> None:
    """Warn with a `Notice` where the files of a controller have changed since a campaign.

    Args:
        run: the campaign.
        plan: the plan with the controllers of now.
    """
    controllers = [(plan.vut, run.settings.vut, run.settings.vut_files)]
    if plan.povs.own is not None:
        controllers.append((plan.povs.own, run.settings.pov or "", run.settings.pov_files))
    for controller, recorded, known in controllers:
        if str(controller.spec) != recorded or known is None:
            continue
        now = files_now({**known}, controller.files or {})
        changed = [file for file, sha256 in known.items() if now[file] != sha256]
        if changed:
            notice(
                f"{printable(changed[0])} has changed since {run.folder}: {controller.spec} may "
                "drive differently now"
            )
