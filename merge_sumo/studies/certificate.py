"""What is certainly absent: a covering lattice of the pool, tested to its last case.

A search says where it found failures, and nothing of where it did not look. A certificate says: in
every ball of a radius, in coordinates of the unit cube and with its centre in the pool, there is a
case that was run and did not fail. So no such ball fails throughout; and as the simulation is
deterministic, that is certain and no estimate. A VUT may not be: some cases run twice, and where
one does not end as before, nothing is certain. What a certificate does not say: that there is no
failure at all. A region that is thinner than the balls may lie between the cases.

certificate.json       what was tested, by what, on which lattice; in the end what was found, hashes
level-2/00007.npz      a block of the cases of a level, as they were run, and what became of them

A third party checks such a folder with `tools/check_certificate.py`, which shares nothing with the
lattice's code (`covering.py`).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo.campaigns.repeats import spread_places
from merge_sumo.campaigns.settings import CampaignSettings, record_of
from merge_sumo.engine.plan import SimulationPlan, differences
from merge_sumo.errors import UserError
from merge_sumo.studies.certificate_blocks import Blocks, block_key
from merge_sumo.studies.certificate_runs import CheckedCase, RunPoints
from merge_sumo.studies.lattice import Covering, covering
from merge_sumo.studies.truth import OnCases
from merge_sumo.system.arrays import regular
from merge_sumo.system.folders import check_own, make_place, new_folder, replace_own
from merge_sumo.system.printable import two_digits
from merge_sumo.system.records import convert, decode
from merge_sumo.values.case import FloatArray
from merge_sumo.values.scenario import Dimension, level_name
from merge_sumo.vuts.files import Files, changed

CERTIFICATE: Final = "certificate.json"
BLOCK: Final = 2000
"""Cases in a file: what a kill may lose."""
WORST: Final = 20
"""Failures of a level that are named."""
TWICE: Final = 100
"""Cases of a level that run twice: at most so many, and a quarter of them."""
OF_A_SEARCH: Final = (
    *("sampler", "cases", "batch", "seed", "stop_after_converged", "learn_from"),
    *("in_process", "policies"),
)
"""Settings of a campaign that decide nothing here."""
UNITS: Final = {"_mps": "m/s", "_m": "m", "_rad": "rad", "_s": "s"}


@dataclass(frozen=True, slots=True)
class Found:
    """What a level of a certificate shows.

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
    levels: dict[int, Found]
    sentence: str

    @property
    def certain(self) -> bool:
        """Whether no ball of the radius fails throughout."""
        return not any(f.failures or f.untold or f.otherwise for f in self.levels.values())


def certify(
    settings: CampaignSettings,
    radius: float,
    folder: Path,
    plan: SimulationPlan,
    run: RunPoints,
    *,
    resume: bool = False,
    on_cases: OnCases | None = None,
    check: Callable[[], None] = lambda: None,
) -> Certificate:
    """Test a covering lattice of the pool, write it into a folder, and return what it shows.

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

    Raises `UserError` where the pool has more than three coordinates, the radius takes too many
    cases, or a folder to go on with is of another VUT, of other versions, or of other settings.
    """
    lattices = lattices_of(settings, radius)
    asked = _asked(settings, radius, lattices, plan)
    if resume:
        files = _again(folder, asked)
    else:
        files = dict(plan.vut.files or {})
        with new_folder(folder) as new:
            (new / CERTIFICATE).write_bytes(_text(asked | {"files": files, "found": None}))
    places = _places(folder, asked, lattices)
    for level, lattice in lattices.items():
        place = places[level]
        check_own(place.folder)
        make_place(place.folder)
        missing = [n for n in range(_count(lattice)) if place.read(n, _size(lattice, n)) is None]
        if on_cases is not None:
            on_cases(len(lattice) - sum(_size(lattice, n) for n in missing))
        known = len(files)
        for number, block in _tested(lattice, missing, partial(run, level), files, on_cases):
            if len(files) > known:
                known = len(files)
                replace_own(folder / CERTIFICATE, _text(asked | {"files": files, "found": None}))
            place.write(number, block)
            check()
    found = {}
    for level, lattice in lattices.items():
        place, dims = places[level], settings.scenario.dimensions(level)
        twice = _twice(place, lattice, partial(run, level))
        found[level] = _found(place, lattice, dims, twice)
        check()
    said = _sentence(radius, found, settings)
    done = Certificate(radius, found, said)
    result = {
        "certain": done.certain,
        "sentence": said,
        "levels": {str(level): asdict(of_level) for level, of_level in found.items()},
    }
    files = dict(sorted(files.items()))
    replace_own(folder / CERTIFICATE, _text(asked | {"files": files, "found": result}))
    return done


def lattices_of(settings: CampaignSettings, radius: float) -> dict[int, Covering]:
    """Return the lattice of each level; `UserError` where there is none."""
    return {
        level: covering(radius, len(settings.scenario.dimensions(level)))
        for level in settings.levels
    }


def _asked(
    settings: CampaignSettings,
    radius: float,
    lattices: Mapping[int, Covering],
    plan: SimulationPlan,
) -> dict[str, Any]:
    """Return what a certificate is of: all that decides what is in it."""
    record = record_of(settings, plan)
    levels = {
        str(level): {
            "coordinates": [asdict(d) for d in settings.scenario.dimensions(level)],
            "steps": list(lattice.steps),
            "covering_radius": lattice.radius,
            "cases": len(lattice),
        }
        for level, lattice in lattices.items()
    }
    return {
        "radius": radius,
        "levels": levels,
        "block": BLOCK,
        "settings": {name: v for name, v in record.items() if name not in OF_A_SEARCH},
    }


def _again(folder: Path, asked: Mapping[str, Any]) -> Files:
    """Return the files of the VUT in a folder to go on with; `UserError` where it is another's."""
    path = folder / CERTIFICATE
    check_own(path)
    try:
        record = decode(regular(path).read_bytes(), dict[str, Any])
        was = {name: record.get(name) for name in asked}
        files: Files = convert(record.get("files"), dict[str, str | None])
    except OSError as error:
        raise UserError(
            f"{folder} is no certificate to go on with: it has no {path.name}"
        ) from error
    except UserError as error:
        raise UserError(f"{path} is not as it was written: {error}") from error
    now = json.loads(json.dumps(asked))
    for name, (before, today) in differences(was, now).items():
        raise UserError(
            f"{name} differs: {folder} was begun with {before}, now it is {today}; make it the "
            "same, or begin anew"
        )
    for name in changed(files):
        raise UserError(f"{name} is not what it was when {folder} was begun: begin anew")
    return files


def _tested(
    lattice: Covering,
    missing: Sequence[int],
    run: Callable[[FloatArray], Iterable[tuple[int, CheckedCase]]],
    files: Files,
    on_cases: OnCases | None,
) -> Iterable[tuple[int, list[CheckedCase]]]:
    """Yield blocks, (number, results), as their last cases end; add to the files of the VUT."""
    if not missing:
        return
    points = np.concatenate([_points(lattice, number) for number in missing])
    starts = np.cumsum([0, *(_size(lattice, number) for number in missing)])
    open_blocks: dict[int, dict[int, CheckedCase]] = {}
    for place, done in run(points):
        nth = int(np.searchsorted(starts, place, side="right")) - 1
        block = open_blocks.setdefault(nth, {})
        block[place - int(starts[nth])] = done
        for name, sha256 in done.files.items():
            files.setdefault(name, sha256)
        if len(block) == starts[nth + 1] - starts[nth]:
            del open_blocks[nth]
            if on_cases is not None:
                on_cases(len(block))
            yield missing[nth], [block[k] for k in range(len(block))]


def _twice(
    place: Blocks, lattice: Covering, run: Callable[[FloatArray], Iterable[tuple[int, CheckedCase]]]
) -> list[bool]:
    """Run some cases of a level once more, in reverse order; return which end as before.

    The first ones, which ran when the VUT was new, are among them.
    """
    count = min(TWICE, -(-len(lattice) // 4))
    numbers = spread_places(len(lattice), count)
    points = np.concatenate([lattice.points(number, number + 1) for number in numbers])
    same = [False] * count
    for nth, done in run(points):
        block, row = divmod(numbers[nth], BLOCK)
        was = place.read(block, _size(lattice, block))
        verdict = np.array([*done.case, done.score, done.failed, done.told])
        same[nth] = was is not None and np.array_equal(
            verdict,
            [*was["case"][row], was["score"][row], was["failed"][row], was["told"][row]],
            equal_nan=True,
        )
    return same


def _found(
    place: Blocks, lattice: Covering, dims: Sequence[Dimension], twice: Sequence[bool]
) -> Found:
    """Read the blocks of a level, one after the other."""
    sha256, failures, untold = hashlib.sha256(), 0, 0
    worst: list[tuple[float, list[float]]] = []
    for number in range(_count(lattice)):
        block = place.read(number, _size(lattice, number))
        if block is None:
            raise UserError(f"{place.file(number)} is not as it was written: resume")
        for name in ("case", "score", "failed", "told"):
            sha256.update(block[name].tobytes())
        failed = block["failed"]
        failures += int(failed.sum())
        untold += int((~block["told"]).sum())
        # Who fails without a score comes last.
        scores = np.nan_to_num(block["score"][failed], nan=0.0).tolist()
        worst += zip(scores, block["case"][failed].tolist(), strict=True)
        worst = sorted(worst)[:WORST]
    names = [d.field for d in dims]
    named = [dict(zip(names, case, strict=True)) | {"score": score} for score, case in worst]
    digest, otherwise = sha256.hexdigest(), twice.count(False)
    return Found(len(lattice), failures, untold, len(twice), otherwise, digest, named)


def _sentence(radius: float, found: Mapping[int, Found], settings: CampaignSettings) -> str:
    most = max((settings.scenario.dimensions(level) for level in found), key=len)
    parts = [f"{two_digits(radius * (d.high - d.low))} {_unit(d)}" for d in most]
    ball = f"ball of radius {100.0 * radius:g} % of the axes ({', '.join(parts)})"
    cases, failures, untold, twice, otherwise = (
        sum(getattr(of_level, name) for of_level in found.values())
        for name in ("cases", "failures", "untold", "twice", "otherwise")
    )
    levels = "/".join(level_name(level) for level in found)
    tested = f"{settings.vut} v level {levels}, {cases:,} cases"
    if not settings.criterion.is_papers:
        tested += f" that may fail by {settings.criterion.in_short}"
    said = f"no {ball} fails throughout: certain, the simulation is deterministic"
    if otherwise:
        said = (
            f"{failures or 'none'} fail, and nothing is certain: {otherwise} of {twice} that were "
            "run twice did not end as before"
        )
    elif failures:
        said = f"{failures:,} fail: every {ball} that fails throughout holds one of them"
    elif untold:
        said = "none fails"
    if untold and not otherwise:
        said += (
            f"; {untold:,} gave no verdict, and no {ball if not failures else 'ball'} is certain "
            "in which there are no others"
        )
    return f"{tested}: {said}"


def _unit(dimension: Dimension) -> str:
    return next(unit for end, unit in UNITS.items() if dimension.field.endswith(end))


def _text(record: dict[str, Any]) -> bytes:
    sha256 = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
    return (json.dumps({**record, "sha256": sha256}, indent=2, allow_nan=False) + "\n").encode()


def _places(
    folder: Path, asked: Mapping[str, Any], lattices: Mapping[int, Covering]
) -> dict[int, Blocks]:
    """Return where the blocks of each level are, and what they are signed as."""
    of = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
    key = block_key()
    return {
        level: Blocks(
            folder / f"level-{level_name(level)}",
            len(lattice.steps),
            f"level {level_name(level)} of the certificate {of}",
            key,
        )
        for level, lattice in lattices.items()
    }


def _count(lattice: Covering) -> int:
    return -(-len(lattice) // BLOCK)


def _points(lattice: Covering, number: int) -> FloatArray:
    return lattice.points(number * BLOCK, (number + 1) * BLOCK)


def _size(lattice: Covering, number: int) -> int:
    return min(BLOCK, len(lattice) - number * BLOCK)
