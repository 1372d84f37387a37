"""Check a certificate of `merge-sumo certify` without merge-sumo: only numpy and scipy are needed.

python tools/check_certificate.py runs/certificate

It trusts neither the lattice nor the sentence, and shares no code with what wrote them. It checks

1. the hashes: of certificate.json, and of all cases and verdicts;
2. that the cases cover the pool: whatever place of the pool one takes as the centre of a ball of
   the radius, in coordinates of the unit cube, a case is in the ball. The cases may be any points;
3. that the counts are those of the verdicts, that "certain" is said only where no case fails, has
   no verdict or ended otherwise when it was run twice, and that failing is a score below -500,
   which it is by every criterion.

The second is decided exactly, but for rounding: the Voronoi cells of the cases, cut off at the
faces, fill the pool, so the farthest place from all cases is a corner of such a cell. Cutting off
at a face is a mirror image of the cases behind it. A cell depends on neighbours within two radii
alone: were there a place of it farther than the radius, there would be one just beyond the radius
on the way to it, and who is nearer to that than the cell's own case is within two radii of the
case. So the pool is cut into slabs with margins of two radii, which bounds memory.

It does not check that the verdicts are those of the VUT: for that, run cases of it again, the
settings are in the file. Exit code 0 when all is well, else 1 with what is not.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import Voronoi

Floats = NDArray[np.float64]

ROUNDING = 1e-9
"""Share of the radius."""
SLAB = 40_000
"""Cases that are looked at in one go, about."""
ARRAYS = ("case", "score", "failed", "told")
FAILURE_SCORE = -500.0


def blocks(folder: Path, level: str, cases: int, size: int) -> Iterator[dict[str, NDArray[Any]]]:
    """Yield the blocks of a level in order; ValueError where one is not as large as it must be."""
    for number in range(-(-cases // size)):
        path = folder / f"level-{'own' if level == '3' else level}" / f"{number:05d}.npz"
        with np.load(path, allow_pickle=False) as data:
            block = {name: data[name] for name in ARRAYS}
        length = min(size, cases - number * size)
        if any(len(values) != length for values in block.values()):
            raise ValueError(f"{path} has not {length} cases")
        yield block


def farthest(points: Floats, radius: float) -> float:
    """Return how far a place of the unit cube can be from all points, (n, d).

    Exact where that is up to the radius; infinity, or some distance beyond, where it is more.
    """
    points = np.unique(points, axis=0)
    margin = 2.0 * radius * (1.0 + 1e-6)
    slabs = max(1, len(points) // SLAB)
    edges = np.linspace(0.0, 1.0, slabs + 1)
    edges[-1] = 2.0
    most, inside = 0.0, 0
    for low, high in pairwise(edges.tolist()):
        mine = (points[:, 0] >= low) & (points[:, 0] < high)
        near = (points[:, 0] >= low - margin) & (points[:, 0] < high + margin)
        inside += int(mine.sum())
        if mine.any():
            most = max(most, _farthest_of(points[mine], points[near & ~mine], margin))
    return most if inside == len(points) > 0 else np.inf


def _farthest_of(own: Floats, others: Floats, margin: float) -> float:
    """Return how far the Voronoi cells of some points of the cube, (n, d), reach from these."""
    around = np.concatenate([own, others])
    for axis in range(around.shape[1]):  # images of images stand behind edges and corners
        images = [around]
        for sign, shift in ((-1.0, 0.0), (-1.0, 2.0), (1.0, -2.0), (1.0, 2.0)):
            image = around.copy()
            image[:, axis] = sign * around[:, axis] + shift
            beyond = np.abs(image[:, axis] - 0.5) - 0.5
            # A point on a face is its own image.
            images.append(image[(beyond > 0.0) & (beyond <= margin)])
        around = np.concatenate(images)
    diagram = Voronoi(around)
    cells = [diagram.regions[diagram.point_region[k]] for k in range(len(own))]
    if any(not cell or -1 in cell for cell in cells):
        return np.inf
    # A cell of a point on a face goes on behind it, as its own mirror image.
    corners = diagram.vertices[np.concatenate(cells)]
    centres = np.repeat(own, [len(cell) for cell in cells], axis=0)
    return float(np.linalg.norm(corners - centres, axis=1).max())


def check(folder: Path) -> tuple[list[str], list[str]]:
    """Return what holds of a certificate, and what does not, in sentences."""
    held: list[str] = []
    wrong: list[str] = []

    def note(holds: bool, sentence: str, otherwise: str) -> None:
        (held if holds else wrong).append(sentence if holds else otherwise)

    record = json.loads((folder / "certificate.json").read_text(encoding="utf-8"))
    written = record.pop("sha256")
    sha256 = hashlib.sha256(json.dumps(record, sort_keys=True).encode()).hexdigest()
    note(sha256 == written, "certificate.json is as it was written", "certificate.json was changed")
    found, radius = record["found"], float(record["radius"])
    if found is None:
        return held, [*wrong, "it is not finished"]
    bad = 0
    for level, stated in record["levels"].items():
        counted, named = found["levels"][level], f"level {level}"
        digest, parts, failures, untold, odd = hashlib.sha256(), [], 0, 0, 0
        for block in blocks(folder, level, int(stated["cases"]), int(record["block"])):
            for name in ARRAYS:
                digest.update(block[name].tobytes())
            parts.append(block["case"])
            failures += int(block["failed"].sum())
            untold += int((~block["told"]).sum())
            odd += int((block["failed"] & ~block["told"]).sum())
            odd += int((block["failed"] != (block["score"] < FAILURE_SCORE)).sum())
        note(
            digest.hexdigest() == counted["sha256"],
            f"{named}: cases and verdicts have the hash that is stated",
            f"{named}: cases or verdicts were changed",
        )
        same = (failures, untold) == (counted["failures"], counted["untold"])
        note(
            same and not odd,
            f"{named}: {failures} of {stated['cases']} cases fail, {untold} gave no verdict",
            f"{named}: {failures} cases fail, {untold} gave no verdict and {odd} contradict "
            "themselves, which is not what is stated",
        )
        bad += failures + untold + int(counted["otherwise"])
        low, high = (
            np.array([float(axis[end]) for axis in stated["coordinates"]])
            for end in ("low", "high")
        )
        pool = ", ".join(
            f"{axis['field']} from {axis['low']:g} to {axis['high']:g}"
            for axis in stated["coordinates"]
        )
        points = np.round((np.concatenate(parts) - low) / (high - low), 12)
        if not ((points >= 0.0) & (points <= 1.0)).all():
            wrong.append(f"{named}: a case is not in the pool")
            continue
        far = farthest(points, radius)
        note(
            far <= radius * (1.0 + ROUNDING),
            f"{named}: no place of the pool, {pool}, is farther than {far:.6f} from a case: every "
            f"ball of radius {radius:g} has one",
            f"{named}: a place of the pool is farther than {radius:g} from every case",
        )
    note(
        found["certain"] == (bad == 0),
        "so it is certain" if bad == 0 else "so it is not certain, and does not say so",
        "it says that it is certain, and is not, or the other way round",
    )
    return held, wrong


def main() -> int:
    """Print what holds and what does not; return the exit code."""
    parser = argparse.ArgumentParser(description="Check a certificate without merge-sumo.")
    parser.add_argument("folder", type=Path)
    try:
        held, wrong = check(parser.parse_args().folder)
    except (OSError, ValueError, KeyError, TypeError) as error:
        print(f"this is no certificate: {error}")
        return 1
    for sentence in held:
        print(f"ok: {sentence}")
    for sentence in wrong:
        print(f"WRONG: {sentence}")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
