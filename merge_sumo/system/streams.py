"""Standard input, output and error of the command line, whatever state a caller leaves them in.

A closed stream would have its number given to the next file that is opened, and Python has no
object for it. What cannot be written to standard output is an error of the command, because its
result is lost; what cannot be written to standard error is lost alone.
"""

from __future__ import annotations

import errno
import os
import signal
import sys
from io import BufferedWriter, FileIO, TextIOWrapper
from typing import TYPE_CHECKING, Final

from merge_sumo.errors import UserError
from merge_sumo.system.interrupt import Stopped

if TYPE_CHECKING:
    from typing_extensions import Buffer

STDIN: Final = 0
STDOUT: Final = 1
STDERR: Final = 2


class _Output(FileIO):
    """A descriptor that is written to until that fails; afterwards what is written is dropped.

    On standard output lies the result: where it cannot be written, that is an error.
    """

    def __init__(self, descriptor: int) -> None:
        super().__init__(descriptor, "w", closefd=False)
        self._failed = False

    def write(self, content: Buffer, /) -> int:
        """Write, and return the bytes that were taken."""
        if not self._failed:
            try:
                return super().write(content) or 0
            except OSError as error:
                self._failed = True
                if self.fileno() == STDOUT:
                    if error.errno == errno.EPIPE and hasattr(signal, "SIGPIPE"):
                        # The reader has gone: it ends as other programs do.
                        raise Stopped(signal.SIGPIPE) from None
                    raise UserError(
                        f"cannot write the result to standard output: {error.strerror}"
                    ) from error
        return memoryview(content).nbytes


def prepare_streams() -> None:
    """Open what is closed to nothing, and make the streams of this process robust.

    Letters that a terminal does not have are written as escapes. Streams that are not the
    interpreter's own, such as those of a notebook or a test, stay as they are.
    """
    opened = _open_closed()
    if STDIN in opened:
        sys.stdin = open(STDIN, encoding="utf-8", closefd=False)  # noqa: SIM115
    if STDOUT in opened or sys.stdout is sys.__stdout__:
        sys.stdout = _text(_Output(STDOUT), sys.__stdout__)
    if STDERR in opened or sys.stderr is sys.__stderr__:
        sys.stderr = _text(_Output(STDERR), sys.__stderr__)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")


def _open_closed() -> set[int]:
    """Give the closed ones of the three descriptors to the null device; return which those are."""
    closed = set()
    for descriptor in (STDIN, STDOUT, STDERR):
        try:
            os.fstat(descriptor)
        except OSError:
            # The lowest free number is taken, and those below are open by now.
            os.open(os.devnull, os.O_RDONLY if descriptor == STDIN else os.O_WRONLY)
            os.set_inheritable(descriptor, True)
            closed.add(descriptor)
    return closed


def _text(raw: _Output, before: object) -> TextIOWrapper:
    """Return a text stream with the encoding and the buffering of the one before, if any."""
    if not isinstance(before, TextIOWrapper):
        return TextIOWrapper(BufferedWriter(raw), encoding="utf-8", line_buffering=True)
    before.flush()
    return TextIOWrapper(
        BufferedWriter(raw),
        encoding=before.encoding,
        newline=None,
        line_buffering=before.line_buffering or raw.isatty(),
        write_through=before.write_through,
    )
