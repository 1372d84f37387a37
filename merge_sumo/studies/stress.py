"""Which verdicts of a campaign hang by a thread: its cases run again, each time a little otherwise.

Every rung of the ladder changes one thing that the simulation leaves out or simplifies (`RUNGS`),
and runs the recorded cases again. A failure is robust where it fails on every rung; a verdict
flips where a case that failed passes, or the other way round, or has no verdict any more.

stress.json             in the folder of a campaign: by rung, the cases whose verdicts flip

The file of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.system.arrays import regular
from merge_sumo.system.records import Record, decode

STRESS: Final = "stress.json"
Index = Annotated[int, Meta(ge=0)]
"""The index of a case in its campaign."""


class Flips(Record, frozen=True):
    """The cases whose verdicts flip in one run of all cases.

    Attributes:
        passes: indices of failures that pass.
        fails: indices of passes that fail.
        without_verdict: indices of cases that end without a verdict.
    """

    passes: tuple[Index, ...] = ()
    fails: tuple[Index, ...] = ()
    without_verdict: tuple[Index, ...] = ()

    @property
    def count(self) -> int:
        """Number of verdicts that flip."""
        return len(self.passes) + len(self.fails) + len(self.without_verdict)


class Rung(Record, frozen=True):
    """What became of the cases on one rung.

    Attributes:
        name: short name, as "lag-0.2".
        about: what is changed, in a phrase.
        source: where its number is from; empty for none.
        runs: the verdicts that flip, by run: several where the change is drawn at random.
        skipped: why it was not run, in a clause; empty where it was.
    """

    name: str
    about: str
    source: str = ""
    runs: tuple[Flips, ...] = ()
    skipped: str = ""

    @property
    def flips(self) -> int:
        """Verdicts that flip, over all runs."""
        return sum(flips.count for flips in self.runs)

    def passes_in(self, index: int) -> int:
        """Return in how many runs a failure does not fail."""
        return sum(index in (*run.passes, *run.without_verdict) for run in self.runs)


class Stress(Record, frozen=True):
    """What a stress test of a campaign found.

    Attributes:
        cases: recorded cases with a verdict: those that ran again.
        failures: indices of those that had failed, the worst first.
        rungs: what became of them on each rung.
        seed: of what is drawn at random.
        vut: name of the VUT.
    """

    cases: int
    failures: tuple[Index, ...]
    rungs: tuple[Rung, ...]
    seed: int
    vut: str

    @property
    def runs(self) -> int:
        """Number of times that every case ran."""
        return sum(len(rung.runs) for rung in self.rungs)

    @property
    def robust(self) -> tuple[int, ...]:
        """Indices of the failures that fail in every run of every rung, the worst first."""
        return tuple(index for index in self.failures if not self.passes_in(index))

    @property
    def fragile(self) -> tuple[int, ...]:
        """Indices of the other failures, those first that fail in the fewest runs."""
        others = (index for index in self.failures if self.passes_in(index))
        return tuple(sorted(others, key=lambda index: -self.passes_in(index)))

    def passes_in(self, index: int) -> int:
        """Return in how many runs of all rungs a failure does not fail."""
        return sum(rung.passes_in(index) for rung in self.rungs)

    def share(self, rung: Rung) -> float | None:
        """Return the share of verdicts that flip on a rung; None where it was not run."""
        verdicts = self.cases * len(rung.runs)
        return rung.flips / verdicts if verdicts else None


def stress_of(folder: Path) -> Stress | None:
    """Return what the folder of a campaign says of a stress test; None where it says nothing.

    Raises `UserError` for a file that is not as it was written.
    """
    path = folder / STRESS
    try:
        known: Stress = decode(regular(path).read_bytes(), Stress)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except UserError as error:
        raise UserError(f"{path} is not as it was written: {error}") from error
    return known
