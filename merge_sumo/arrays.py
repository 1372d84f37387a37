"""Arrays from files that may have been changed."""

from __future__ import annotations

import io
import struct
import tokenize
import zipfile
import zlib
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from merge_sumo.folders import regular

UNREADABLE_NPZ: Final = (
    *(OSError, EOFError, ValueError, TypeError, KeyError, IndexError, AttributeError),
    *(SyntaxError, RuntimeError, ArithmeticError, MemoryError),
    *(zipfile.BadZipFile, zipfile.LargeZipFile, zlib.error, struct.error, tokenize.TokenError),
)
"""What numpy raises when a file is not the archive of arrays that it should be."""


def read_arrays(file: Path | io.BytesIO, *names: str) -> dict[str, NDArray[Any]]:
    """Return the arrays of an .npz file of ours, or those that are named.

    Raises one of `UNREADABLE_NPZ` where there is none, or what is there is something else: ours are
    not compressed, so that no file is more than it looks.
    """
    with np.load(regular(file) if isinstance(file, Path) else file, allow_pickle=False) as data:
        if any(member.compress_type != zipfile.ZIP_STORED for member in data.zip.infolist()):
            raise ValueError("it is compressed")
        return {name: data[name] for name in names or data.files}
