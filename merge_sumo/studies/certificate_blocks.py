"""The blocks of a level of a certificate: files of cases and verdicts, signed by who ran them.

A block that this user has not signed is not believed when a certificate goes on: its cases run
again. For who reads it without our code, the signature behind an .npz archive is not there.
"""

from __future__ import annotations

import io
import secrets
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.errors import UserError
from merge_sumo.studies.certificate_runs import CheckedCase
from merge_sumo.system.arrays import UNREADABLE_NPZ, read_arrays, regular
from merge_sumo.system.folders import replace_own
from merge_sumo.system.signature import signed, user_key, verified

TYPES: Final = {"case": "<f8", "score": "<f8", "failed": "|b1", "told": "|b1"}


def block_key() -> bytes:
    """Return what blocks are signed with: the user's key, or one that nobody has later on."""
    try:
        return user_key()
    except UserError:
        return secrets.token_bytes(32)


@dataclass(frozen=True, slots=True)
class Blocks:
    """The blocks of a level.

    Attributes:
        folder: where they are.
        dims: coordinates of a case.
        of: what tells this level of this certificate from any other.
        key: what they are signed with.
    """

    folder: Path
    dims: int
    of: str
    key: bytes

    def file(self, number: int) -> Path:
        """Return the path of a block."""
        return self.folder / f"{number:05d}.npz"

    def write(self, number: int, results: Sequence[CheckedCase]) -> None:
        """Write a block; `UserError` where that cannot be."""
        arrays = io.BytesIO()
        np.savez(
            arrays,
            case=np.array([done.case for done in results], dtype="<f8"),
            score=np.array([done.score for done in results], dtype="<f8"),
            failed=np.array([done.failed for done in results], dtype=np.bool_),
            told=np.array([done.told for done in results], dtype=np.bool_),
        )
        replace_own(self.file(number), signed(arrays.getvalue(), self._what(number), self.key))

    def read(self, number: int, size: int) -> dict[str, NDArray[Any]] | None:
        """Return a block of `size` cases; None where it is not there, or is not what we wrote."""
        try:
            content = regular(self.file(number)).read_bytes()
            inner = verified(content, self._what(number), self.key)
            if inner is None:
                return None
            block = read_arrays(io.BytesIO(inner), *TYPES)
        except UNREADABLE_NPZ:
            return None
        shapes = dict.fromkeys(TYPES, (size,)) | {"case": (size, self.dims)}
        fits = all(block[name].shape == shapes[name] for name in TYPES)
        return block if fits and all(block[n].dtype == kind for n, kind in TYPES.items()) else None

    def _what(self, number: int) -> str:
        return f"block {number} of {self.of}"
