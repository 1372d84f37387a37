"""Whether other simulators agree with a campaign: on motion, on verdicts, on measures.

crosscheck.json         in the folder of a campaign: what agrees, and each verdict that does not

The file of a folder which somebody sent is data as everything in it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Final

from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.system.arrays import regular
from merge_sumo.system.records import Record, decode

CROSSCHECK: Final = "crosscheck.json"
Count = Annotated[int, Meta(ge=0)]
Deviation = Annotated[float, Meta(ge=0.0)]


class Motion(Record, frozen=True):
    """How far recorded motions are from those of the other simulator.

    Attributes:
        cases: recorded cases whose accelerations were given to its vehicles.
        steps: steps of all of them.
        largest_m: largest difference of a position.
        largest_mps: largest difference of a speed.
        worst_case: index of the case with the largest difference of a position; None without cases.
    """

    cases: Count
    steps: Count
    largest_m: Deviation
    largest_mps: Deviation
    worst_case: Count | None


class Difference(Record, frozen=True):
    """A case with another verdict, or another end, in the other simulator.

    Attributes:
        index: of the recorded case, or of the fresh one.
        fresh: whether it is a fresh case.
        level: level of the POV.
        in_sumo: how it ended in SUMO, as "failed, MERGED".
        in_peer: how it ended in the other simulator.
        time_s: of the first step with another motion; None where one only goes on for longer.
        reason: why, in a clause.
    """

    index: Count
    fresh: bool
    level: int
    in_sumo: str
    in_peer: str
    time_s: float | None
    reason: str


class Verdicts(Record, frozen=True):
    """How many verdicts are the same where VUT and POV drive in the other simulator.

    Attributes:
        recorded: cases of the campaign that ran there.
        fresh: uniform cases that ran in both simulators.
        failures: those among both that fail in SUMO.
        largest_m: largest difference of a position in cases with the same verdict.
        differences: the cases with another verdict or another end.
    """

    recorded: Count
    fresh: Count
    failures: Count
    largest_m: Deviation
    differences: tuple[Difference, ...]

    @property
    def cases(self) -> int:
        """Number of cases that ran in both simulators."""
        return self.recorded + self.fresh

    @property
    def same(self) -> int:
        """Number of cases with the same verdict and end."""
        return self.cases - len(self.differences)


class MeasureCheck(Record, frozen=True):
    """How a measure compares with that of another tool.

    Attributes:
        name: our measure.
        peer_name: its name there.
        cases: cases in which both have a value, or neither has one.
        same: cases in which the values are the same, once the definition of the other tool is
            taken: to its rounding.
        largest: largest difference otherwise; None where there is none.
        definition: in what the definitions differ, in a sentence; empty where they do not.
    """

    name: str
    peer_name: str
    cases: Count
    same: Count
    largest: Deviation | None
    definition: str


class Measured(Record, frozen=True):
    """Measures by another tool.

    Attributes:
        tool: its name and version.
        cases: recorded cases that it measured.
        measures: how each compares.
    """

    tool: str
    cases: Count
    measures: tuple[MeasureCheck, ...]


class Crosscheck(Record, frozen=True):
    """What other simulators say of a campaign.

    Attributes:
        peer: name and version of the other simulator.
        motion: of the recorded cases.
        verdicts: of VUT and POV driving there; None where they cannot.
        why_no_verdicts: why they cannot, in a clause; empty where they can.
        measured: measures by another tool; None where it was not asked.
        vut: name of the VUT.
        seed: of the fresh cases.
    """

    peer: str
    motion: Motion
    verdicts: Verdicts | None
    why_no_verdicts: str
    measured: Measured | None
    vut: str
    seed: int


def crosscheck_of(folder: Path) -> Crosscheck | None:
    """Return what the folder of a campaign says of a crosscheck; None where it says nothing.

    Raises `UserError` for a file that is not as it was written.
    """
    path = folder / CROSSCHECK
    try:
        known: Crosscheck = decode(regular(path).read_bytes(), Crosscheck)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except UserError as error:
        raise UserError(f"{path} is not as it was written: {error}") from error
    return known
