"""A certificate of absence: a covering lattice of the pool, tested to its last case.

A search reports the failures that it found, and little about the rest of the pool. A certificate
says: in every ball of a radius, in coordinates of the unit cube and with its centre in the pool, a
case was run and did not fail. So no such ball fails throughout; and as the simulation is
deterministic, that is certain and no estimate. A VUT may not be: some cases run twice, and where
one does not end as before, nothing is certain. A certificate does not prove that no failure exists:
a region that is thinner than the balls may lie between the cases.

certificate.json       what was tested, by what, on which lattice; in the end the result, hashes
level-2/00007.npz      a block of the cases of a level, as they were run, and their verdicts

A third party checks such a folder with `tools/check_certificate.py`, which shares nothing with this
file.

It is no campaign with a sampler that walks the lattice: a campaign keeps an outcome of 0.8 kB and a
motion of 4 kB per case, and all outcomes in memory (60 cases at level 0 and 1, measured), which at
three million cases is 15 GB of files. A certificate keeps 34 bytes per case, holds one block in
memory, believes only blocks that this user has signed, and resumes to the same bytes.
"""

from __future__ import annotations

import hashlib
import io
import json
import math
import secrets
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from merge_sumo.campaigns.repeats import spread_places
from merge_sumo.campaigns.settings import CampaignSettings, record_of
from merge_sumo.engine.evaluate import CaseResults, CasesAt, evaluate
from merge_sumo.engine.kinematic_simulator import CHECKED_SHARE
from merge_sumo.engine.plan import Engine, SimulationPlan, differences
from merge_sumo.errors import UserError
from merge_sumo.studies.truth import OnCases
from merge_sumo.system.arrays import UNREADABLE_NPZ, read_arrays, regular
from merge_sumo.system.folders import check_own, make_place, new_folder, replace_own
from merge_sumo.system.hashing import Files, changed
from merge_sumo.system.printable import two_digits
from merge_sumo.system.records import Record, convert, decode, read_record
from merge_sumo.system.signature import signed, user_key, verified
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import Dimension, level_name
from merge_sumo.vuts.output import LOG

CERTIFICATE: Final = "certificate.json"
BLOCK: Final = 2000
"""Cases in a file: what a kill may lose."""
WORST: Final = 20
"""Failures of a level that are named."""
TWICE: Final = 100
"""Cases of a level that run twice: at most so many, and a quarter of them."""
OF_A_SEARCH: Final = (
    *("sampler", "cases", "batch", "in_flight", "audit", "seed"),
    *("stop_after_converged", "learn_from"),
    "policies",
)
"""Settings of a campaign that decide nothing here."""
SLACK: Final = 1e-9
"""Share of the radius that is left for rounding."""
MOST_POINTS: Final = 3_000_000
"""The most cases of a level; level 2 at the default radius has 360,809, some 200 s of CPU time."""


# The lattice.


@dataclass(frozen=True, slots=True)
class CoveringLattice:
    """A lattice of the unit square or cube, of which every ball of a radius contains a point.

    The points are those of a grid whose indices are all even or all odd: in two dimensions a
    centred rectangular lattice, hexagonal except for a stretch of less than a step; in three the
    body-centred cubic one. These cover space with the fewest points of all lattices (Kershner,
    1939; Bambah, 1954).

    Cases outside the pool cannot be run, and need not be. With n steps along an axis, both faces of
    the cube stand on the grid. A mirror in the face 0 takes index i to -i, one in the face 1 takes
    it to 2 n - i; both keep it even or odd, so the lattice is its own image. Fold space into the
    cube by these mirrors: no two places get farther apart, places in the cube stay, and lattice
    points become lattice points in the cube. So let c be in the cube, and p the nearest point of
    the infinite lattice, at most the covering radius away: p folded is a point of the lattice in
    the cube that is no farther from c. The points in the closed cube alone cover it.

    Attributes:
        steps: of the grid along each axis, 1 / steps apart; in three dimensions all the same.

    Raises:
        UserError: for steps that make no such lattice.
    """

    steps: tuple[int, ...]

    def __post_init__(self) -> None:
        same = len(self.steps) == 2 or len(set(self.steps)) == 1
        if len(self.steps) not in (2, 3) or min(self.steps) < 1 or not same:
            raise UserError(f"there is no covering lattice with steps {self.steps}")

    @property
    def radius(self) -> float:
        """The covering radius: no place of the cube is farther from a point.

        In the plane the nearest points are corners of triangles with two sides of squared length
        p^2 + h^2 and a base of 2 p, p <= h the distances of the grid: they are acute, so the place
        that is farthest from their corners is the centre of their circle, (p^2 + h^2) / (2 h). In
        space it is the corner of the truncated octahedron around a point, sqrt(5) / 4 times the
        edge of the cube, which is two steps long.
        """
        p, h = sorted(1.0 / n for n in self.steps[:2])
        return (p * p + h * h) / (2.0 * h) if len(self.steps) == 2 else math.sqrt(5.0) / 2.0 * p

    def __len__(self) -> int:
        return sum(math.prod(self._shape(odd)) for odd in (0, 1))

    def points(self, first: int, end: int) -> FloatArray:
        """Return points `first` to `end` - 1, (n, d), those up to the last one."""
        numbers, evens = np.arange(first, min(end, len(self))), math.prod(self._shape(0))
        parts = [
            np.stack(np.unravel_index(part, self._shape(odd)), axis=-1) * 2 + odd
            for odd, part in ((0, numbers[numbers < evens]), (1, numbers[numbers >= evens] - evens))
        ]
        points: FloatArray = np.concatenate(parts) / np.array(self.steps, dtype=np.float64)
        return points

    def _shape(self, odd: int) -> tuple[int, ...]:
        """Return the number of even, or odd, indices from 0 to the steps of each axis."""
        return tuple((n + 1) // 2 if odd else n // 2 + 1 for n in self.steps)


def covering(radius: float, dimensions: int) -> CoveringLattice:
    """Return the lattice with the fewest points that covers the unit square or cube.

    Raises:
        UserError: for a radius that is none, or that takes more than `MOST_POINTS`, and for more
            than three dimensions.
    """
    if dimensions not in (2, 3):
        raise UserError(
            f"the pool has {dimensions} coordinates: a covering lattice is known to be the best in "
            "two and three, and takes too many cases in more; narrow the scenario"
        )
    if not 0.0 < radius <= 0.5:
        raise UserError(f"--radius is {radius}: it is a share of the axes, above 0 and up to 0.5")
    points: float = 0.8 * (0.5 / radius) ** dimensions  # fewer than any lattice needs
    if points <= MOST_POINTS:
        reach = radius * (1.0 - SLACK)
        if dimensions == 3:
            lattice = CoveringLattice((math.ceil(math.sqrt(5.0) / 2.0 / reach),) * 3)
        else:
            # From the steps of one axis follow those of the other: h^2 - 2 r h + p^2 <= 0.
            fewest = math.ceil(1.0 / reach)
            choices = [
                (n, reach + math.sqrt(max(reach * reach - 1.0 / (n * n), 0.0)))
                for n in range(fewest, 2 * fewest + 1)
            ]
            lattice = min(
                (CoveringLattice((n, math.ceil(1.0 / highest))) for n, highest in choices), key=len
            )
        points = len(lattice)
        if points <= MOST_POINTS:
            return lattice
    raise UserError(
        f"--radius is {radius}: it takes {points:.2g} cases and more at a level, of which "
        f"{MOST_POINTS:,} are the most; choose a larger one"
    )


def lattices_of(settings: CampaignSettings, radius: float) -> dict[int, CoveringLattice]:
    """Return the lattice of each level; `UserError` where it has none."""
    return {
        level: covering(radius, len(settings.scenario.dimensions(level)))
        for level in settings.levels
    }


# Cases: points of the unit cube in, verdicts out.


class CheckedCase(NamedTuple):
    """The verdict on a case.

    Attributes:
        case: its coordinates as they were run.
        score: NaN without a verdict.
        failed: whether it failed.
        told: whether it has a verdict: the VUT reached the merge point, or failed.
        files: those that VUT and POV have loaded.
    """

    case: tuple[float, ...]
    score: float
    failed: bool
    told: bool
    files: Files


RunPoints = Callable[[int, FloatArray], Iterable[tuple[int, CheckedCase]]]
"""Runs the cases at points, (n, d), of a level's unit cube; gives (place, result) in any order."""


def runs_points_on(
    workers: Workers, settings: CampaignSettings, plan: SimulationPlan, folder: Path
) -> RunPoints:
    """Return what runs points on workers; what a controller prints goes to the folder's log."""
    plan = plan.with_log(folder.resolve() / LOG)

    def run(level: int, points: FloatArray) -> Iterable[tuple[int, CheckedCase]]:
        return evaluate(plan, CasesAt(settings.pool, level, points), workers, _checked)

    return run


def _checked(results: CaseResults) -> list[CheckedCase]:
    # One dictionary for a chunk: it travels once.
    files = results.files | results.pov_files
    checked = []
    for trajectory, verdict in zip(results.trajectories, results.verdicts(), strict=True):
        case, score = trajectory.case, math.nan if verdict.score is None else verdict.score
        values = tuple(getattr(case, d.field) for d in case.scenario.dimensions(case.level))
        checked.append(CheckedCase(values, score, verdict.failed, verdict.is_tested, files))
    return checked


# Blocks: files of cases and verdicts, signed by the user who ran them.


TYPES: Final = {"case": "<f8", "score": "<f8", "failed": "|b1", "told": "|b1"}
"""Arrays of a block and their types."""


@dataclass(frozen=True, slots=True)
class Blocks:
    """The lattice of a level in blocks, and their files.

    A block that this user has not signed is not believed when a certificate goes on: its cases run
    again. For readers without our code, the signature is behind the .npz archive.

    Attributes:
        folder: where the files are.
        lattice: the points.
        of: what tells this level of this certificate from any other.
        key: what the files are signed with.
    """

    folder: Path
    lattice: CoveringLattice
    of: str
    key: bytes

    @property
    def count(self) -> int:
        """Number of blocks."""
        return -(-len(self.lattice) // BLOCK)

    def size(self, number: int) -> int:
        """Return the number of cases in a block."""
        return min(BLOCK, len(self.lattice) - number * BLOCK)

    def points(self, number: int) -> FloatArray:
        """Return the points of a block, (n, d)."""
        return self.lattice.points(number * BLOCK, (number + 1) * BLOCK)

    def file(self, number: int) -> Path:
        """Return the path of a block."""
        return self.folder / f"{number:05d}.npz"

    def write(self, number: int, results: Sequence[CheckedCase]) -> None:
        """Write a block; `UserError` where that cannot be."""
        arrays = io.BytesIO()
        columns = {
            name: np.array([getattr(result, name) for result in results], dtype=dtype)
            for name, dtype in TYPES.items()
        }
        np.savez(arrays, **columns)  # type: ignore[arg-type]
        replace_own(self.file(number), signed(arrays.getvalue(), self._named(number), self.key))

    def read(self, number: int) -> dict[str, NDArray[Any]] | None:
        """Return a block; None where it is missing, or is not what we wrote."""
        try:
            content = regular(self.file(number)).read_bytes()
            inner = verified(content, self._named(number), self.key)
            if inner is None:
                return None
            block = read_arrays(io.BytesIO(inner), *TYPES)
        except UNREADABLE_NPZ:
            return None
        size = self.size(number)
        shapes = dict.fromkeys(TYPES, (size,)) | {"case": (size, len(self.lattice.steps))}
        fits = all(
            block[name].shape == shapes[name] and block[name].dtype == dtype
            for name, dtype in TYPES.items()
        )
        return block if fits else None

    def run_missing(
        self, run: Callable[[FloatArray], Iterable[tuple[int, CheckedCase]]], on_cases: OnCases
    ) -> Iterable[tuple[int, list[CheckedCase]]]:
        """Run the blocks that are missing; yield (number, results) of each as its last case ends.

        Args:
            run: runs cases at points, (n, d), and gives (place, result).
            on_cases: told how many cases are known, and then how many of a block have ended.
        """
        check_own(self.folder)
        make_place(self.folder)
        missing = [number for number in range(self.count) if self.read(number) is None]
        on_cases(len(self.lattice) - sum(map(self.size, missing)))
        if not missing:
            return
        starts = np.cumsum([0, *(self.size(number) for number in missing)])
        open_blocks: dict[int, dict[int, CheckedCase]] = {}
        for place, result in run(np.concatenate([self.points(number) for number in missing])):
            nth = int(np.searchsorted(starts, place, side="right")) - 1
            block = open_blocks.setdefault(nth, {})
            block[place - int(starts[nth])] = result
            if len(block) == self.size(missing[nth]):
                del open_blocks[nth]
                on_cases(len(block))
                yield missing[nth], [block[k] for k in range(len(block))]

    def run_twice(
        self, run: Callable[[FloatArray], Iterable[tuple[int, CheckedCase]]]
    ) -> list[bool]:
        """Run some cases once more, in reverse order; return which end as before.

        The first ones, which ran when the VUT was new, are among them.
        """
        numbers = spread_places(len(self.lattice), min(TWICE, -(-len(self.lattice) // 4)))
        points = np.concatenate([self.lattice.points(number, number + 1) for number in numbers])
        same = [False] * len(numbers)
        for nth, result in run(points):
            number, row = divmod(numbers[nth], BLOCK)
            block = self.read(number)
            same[nth] = block is not None and all(
                np.array_equal(getattr(result, name), block[name][row], equal_nan=True)
                for name in TYPES
            )
        return same

    def _named(self, number: int) -> str:
        return f"block {number} of {self.of}"


# The certificate.


@dataclass(frozen=True, slots=True)
class LevelResult:
    """The result of a level.

    Attributes:
        cases: how many were run.
        failures: how many of them fail.
        untold: how many gave no verdict: errors, and timeouts unless they are failures.
        twice: how many were run once more, in another order.
        otherwise: how many of these did not end as before, to the last bit of their score.
        sha256: of all cases and verdicts, in their order.
        worst: the failures with the lowest scores, coordinates by name, with their score.
    """

    cases: int
    failures: int
    untold: int
    twice: int
    otherwise: int
    sha256: str
    worst: list[dict[str, float]]


@dataclass(frozen=True, slots=True)
class Certificate:
    """A certificate that is complete."""

    radius: float
    levels: dict[int, LevelResult]
    sentence: str

    @property
    def certain(self) -> bool:
        """Whether no ball of the radius fails throughout."""
        return not any(of.failures or of.untold or of.otherwise for of in self.levels.values())


class CertificateFound(Record, frozen=True):
    """The result in the file of a certificate.

    Attributes:
        certain: whether no ball of the radius fails throughout.
        sentence: the result in words.
        levels: `LevelResult` by level.
    """

    certain: bool
    sentence: str
    levels: dict[str, LevelResult]


class CertificateFile(Record, frozen=True):
    """What the file of a certificate says.

    Attributes:
        radius: of the balls, as a share of the axes.
        levels: the lattice of each level.
        block: cases in a file.
        engine: what moved the vehicles.
        settings: what was tested.
        files: hashes of the files of the VUT.
        found: the result; None before the end.
        sha256: hash of all other keys.
    """

    radius: float
    levels: dict[str, Any]
    block: int
    engine: str
    settings: dict[str, Any]
    files: dict[str, str | None]
    found: CertificateFound | None
    sha256: str


def certificate_of(folder: Path) -> CertificateFile:
    """Return what the folder of a certificate says; `UserError` where it is not as it was written.

    Its blocks are not read: `tools/check_certificate.py` checks them.
    """
    path = folder / CERTIFICATE
    known = read_record(path, CertificateFile)
    if known is None:
        raise UserError(f"{folder} is no certificate: it has no {CERTIFICATE}")
    record = decode(regular(path).read_bytes(), dict[str, Any])
    written = record.pop("sha256")
    if written != hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest():
        raise UserError(f"{path} is not as it was written: its hash is another one")
    return known


def certify(
    settings: CampaignSettings,
    radius: float,
    folder: Path,
    plan: SimulationPlan,
    run: RunPoints,
    *,
    resume: bool = False,
    on_cases: OnCases = lambda _: None,
    check: Callable[[], None] = lambda: None,
) -> Certificate:
    """Test a covering lattice of the pool, write it into a folder, and return the result.

    Same settings, same versions: the same bytes, whatever the workers and however often it was
    stopped.

    Args:
        settings: VUT, levels and scenario; those of a search decide nothing.
        radius: of the balls, as a share of the axes.
        folder: new; with `resume`, that of a certificate that was stopped.
        plan: how cases run: that of the settings.
        run: runs cases: `runs_points_on`.
        resume: go on with what the folder holds.
        on_cases: told how many cases have ended.
        check: called after every block; may raise to stop there.

    Raises:
        UserError: where the pool has more than three coordinates, the radius takes too many cases,
            or a folder to go on with is of another VUT, of other versions, or of other settings.
    """
    lattices = lattices_of(settings, radius)
    subject = _subject(settings, radius, lattices, plan)

    def text(files: Files, found: dict[str, Any] | None) -> bytes:
        record = subject | {"files": files, "found": found}
        sha256 = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
        return (json.dumps({**record, "sha256": sha256}, indent=2, allow_nan=False) + "\n").encode()

    if resume:
        files = _files_to_go_on(folder, subject)
    else:
        files = dict(plan.vut.files or {})
        with new_folder(folder) as new:
            (new / CERTIFICATE).write_bytes(text(files, None))
    levels = _blocks(folder, subject, lattices)
    for level, blocks in levels.items():
        for number, results in blocks.run_missing(partial(run, level), on_cases):
            known = len(files)
            for result in results:
                for name, sha256 in result.files.items():
                    files.setdefault(name, sha256)
            if len(files) > known:
                # Before the block: what it rests on must be known where it is believed.
                replace_own(folder / CERTIFICATE, text(files, None))
            blocks.write(number, results)
            check()
    found = {}
    for level, blocks in levels.items():
        same = blocks.run_twice(partial(run, level))
        found[level] = _level_result(blocks, settings.scenario.dimensions(level), same)
        check()
    done = Certificate(radius, found, _sentence(radius, found, settings, plan.engine))
    summary = {
        "certain": done.certain,
        "sentence": done.sentence,
        "levels": {str(level): asdict(of_level) for level, of_level in found.items()},
    }
    replace_own(folder / CERTIFICATE, text(dict(sorted(files.items())), summary))
    return done


def _subject(
    settings: CampaignSettings,
    radius: float,
    lattices: Mapping[int, CoveringLattice],
    plan: SimulationPlan,
) -> dict[str, Any]:
    """Return what a certificate is of: all that decides what is in it."""
    levels = {
        str(level): {
            "coordinates": [asdict(d) for d in settings.scenario.dimensions(level)],
            "steps": list(lattice.steps),
            "covering_radius": lattice.radius,
            "cases": len(lattice),
        }
        for level, lattice in lattices.items()
    }
    record = record_of(settings, plan)
    return {
        "radius": radius,
        "levels": levels,
        "block": BLOCK,
        "engine": plan.engine,
        "settings": {name: v for name, v in record.items() if name not in OF_A_SEARCH},
    }


def _files_to_go_on(folder: Path, subject: Mapping[str, Any]) -> Files:
    """Return the files of the VUT in a folder to go on with; `UserError` where it is another's."""
    path = folder / CERTIFICATE
    check_own(path)
    try:
        record = decode(regular(path).read_bytes(), dict[str, Any])
        files: Files = convert(record.get("files"), dict[str, str | None])
    except OSError as error:
        raise UserError(
            f"{folder} is no certificate to go on with: it has no {path.name}"
        ) from error
    except UserError as error:
        raise UserError(f"{path} is not as it was written: {error}") from error
    begun = {name: record.get(name) for name in subject}
    for name, (before, today) in differences(begun, json.loads(json.dumps(subject))).items():
        raise UserError(
            f"{name} differs: {folder} was begun with {before}, now it is {today}; make it the "
            "same, or begin anew"
        )
    for name in changed(files):
        raise UserError(f"{name} is not what it was when {folder} was begun: begin anew")
    return files


def _blocks(
    folder: Path, subject: Mapping[str, Any], lattices: Mapping[int, CoveringLattice]
) -> dict[int, Blocks]:
    """Return the blocks of each level, signed by this user for this certificate alone."""
    sha256 = hashlib.sha256(json.dumps(subject, sort_keys=True).encode()).hexdigest()
    try:
        key = user_key()
    except UserError:
        key = secrets.token_bytes(32)  # nobody has it later on: nothing is believed
    blocks = {}
    for level, lattice in lattices.items():
        name = level_name(level)
        of = f"level {name} of the certificate {sha256}"
        blocks[level] = Blocks(folder / f"level-{name}", lattice, of, key)
    return blocks


def _level_result(blocks: Blocks, dims: Sequence[Dimension], same: Sequence[bool]) -> LevelResult:
    """Read the blocks of a level, one after the other; `same`: which ended twice the same way."""
    sha256, failures, untold = hashlib.sha256(), 0, 0
    worst: list[tuple[float, list[float]]] = []
    for number in range(blocks.count):
        block = blocks.read(number)
        if block is None:
            raise UserError(f"{blocks.file(number)} is not as it was written: resume")
        for name in TYPES:
            sha256.update(block[name].tobytes())
        failed = block["failed"]
        failures += int(failed.sum())
        untold += int((~block["told"]).sum())
        # A failure without a score comes last.
        scores = np.nan_to_num(block["score"][failed], nan=0.0).tolist()
        worst += zip(scores, block["case"][failed].tolist(), strict=True)
        worst = sorted(worst)[:WORST]
    names = [d.field for d in dims]
    named = [dict(zip(names, case, strict=True)) | {"score": score} for score, case in worst]
    return LevelResult(
        len(blocks.lattice),
        failures,
        untold,
        len(same),
        same.count(False),
        sha256.hexdigest(),
        named,
    )


def _sentence(
    radius: float,
    found: Mapping[int, LevelResult],
    settings: CampaignSettings,
    engine: Engine,
) -> str:
    """Return the result of all levels in a sentence."""
    most = max((settings.scenario.dimensions(level) for level in found), key=len)
    units = [settings.scenario.notation[d.field].unit for d in most]
    parts = [
        f"{two_digits(radius * (d.high - d.low))} {unit}"
        for d, unit in zip(most, units, strict=True)
    ]
    ball = f"ball of radius {100.0 * radius:g} % of the axes ({', '.join(parts)})"
    cases, failures, untold, twice, otherwise = (
        sum(getattr(of_level, name) for of_level in found.values())
        for name in ("cases", "failures", "untold", "twice", "otherwise")
    )
    levels = "/".join(level_name(level) for level in found)
    tested = f"{settings.vut} v level {levels}, {cases:,} cases"
    if engine is Engine.KINEMATIC:
        tested += f" by the equations of motion, at least {CHECKED_SHARE:.0%} of them in SUMO, too,"
    if not settings.criterion.is_papers:
        tested += f" that may fail by {settings.criterion.in_short}"
    if otherwise:
        return (
            f"{tested}: {failures or 'none'} fail, and nothing is certain: {otherwise} of {twice} "
            "that were run twice did not end as before"
        )
    if failures:
        result = f"{failures:,} fail: every {ball} that fails throughout holds one of them"
    elif untold:
        result = "none fails"
    else:
        result = f"no {ball} fails throughout: certain, the simulation is deterministic"
    if untold:
        result += (
            f"; {untold:,} gave no verdict, and no {'ball' if failures else ball} is certain "
            "in which there are no others"
        )
    return f"{tested}: {result}"
