"""Standard streams of the command line: robust against closed ones, full disks and lost readers.

What cannot be written to standard output is an error of the command, because its result is lost;
what cannot be written to standard error is lost alone.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import TYPE_CHECKING, Final

from merge_sumo.errors import UserError
from merge_sumo.interrupt import Stopped

if TYPE_CHECKING:
    from typing_extensions import Buffer

STDOUT: Final = 1


class _Output(FileIO):
    """A descriptor that is written to until that fails; afterwards what is written is dropped."""

    _failed = False

    def write(self, content: Buffer, /) -> int:
        """Write, and return the bytes that were taken."""
        if not self._failed:
            try:
                return super().write(content) or 0
            except OSError as error:
                self._failed = True
                if self.fileno() == STDOUT and error.errno == errno.EPIPE:
                    # The reader has gone: the command ends as other programs do.
                    raise Stopped(signal.SIGPIPE) from None
                if self.fileno() == STDOUT:
                    raise UserError(
                        f"cannot write the result to standard output: {error.strerror}"
                    ) from error
        return memoryview(content).nbytes


def prepare_streams() -> None:
    """Open closed streams to nothing, and make the interpreter's own output streams robust.

    Letters that a terminal does not have are written as escapes.
    """
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:  # a file would get its number, and what is printed
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for descriptor, name in ((STDOUT, "stdout"), (2, "stderr")):
        stream = getattr(sys, name)
        if isinstance(stream, TextIOWrapper) and stream is getattr(sys, f"__{name}__"):
            raw = _Output(descriptor, "w", closefd=False)
            buffering = stream.line_buffering or raw.isatty()
            robust = TextIOWrapper(
                BufferedWriter(raw), stream.encoding, "backslashreplace", line_buffering=buffering
            )
            setattr(sys, name, robust)
