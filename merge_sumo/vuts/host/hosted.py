"""A user's VUT in a process of its own, so that it can take down nothing but itself.

Each step is a question to that process and its answer. When the process dies, or answers nothing
for longer than the deadline, it is killed and started again: the corridor at fault is in memory
that both share, and the episodes of the other corridors begin anew.
"""

from __future__ import annotations

import math
import mmap
import os
import select
import signal
import subprocess
import tempfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, Final, TypeVar

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import Driver, Scene, VutLostError
from merge_sumo.errors import UserError
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.scenario.signals import Left
from merge_sumo.system.blame import Blame, how_it_ended
from merge_sumo.system.hashing import Files, changed, hashed
from merge_sumo.system.pulse import AwakeClock
from merge_sumo.system.scratch import ScratchFolder
from merge_sumo.system.spawning import python_command
from merge_sumo.vuts.base import Deadline, Vut, VutOptions, VutSpec
from merge_sumo.vuts.blame_cell import BlameCell
from merge_sumo.vuts.host import wire
from merge_sumo.vuts.host.wire import About, Facts, Frame, Lost, Opening, Said, WireError
from merge_sumo.vuts.process import Echo, Output

T = TypeVar("T")

HOSTING: Final = "merge_sumo.vuts.host.process:main"
"""What runs in the process of a VUT."""
SUPPORTED: Final = os.name == "posix"
"""Elsewhere descriptors do not pass to another process, and a VUT runs in this one."""
GRACE: Final = 1.5
"""Of the deadline: by then the other process should have ended the call by itself."""
GRACE_S: Final = 1.0
"""More of it, for a busy machine."""
LOOK_S: Final = 0.25
"""A dead process may have left its end of the channel to another: look for its death, too."""
ENDING_S: Final = 2.0


_known: dict[tuple[VutSpec, str, float], tuple[Facts, Files]] = {}
"""Facts by what is alike, working folder and memory: no process is started where no file has
changed."""


def hosted_vut(spec: VutSpec, options: VutOptions, alike: VutSpec) -> Vut:
    """Return a VUT whose code runs in a process of its own; `UserError` where it cannot be opened.

    VUTs that are `alike` share their facts: only the first is opened for them.
    """
    key = alike, str(Path.cwd()), options.memory_gib
    if key not in _known or changed(_known[key][1]):
        host = _first(lambda: Host(spec, options, Echo()))
        host.kill()
        _known[key] = host.facts, hashed(map(Path, host.facts.files))
    facts = _known[key][0]

    def make(corridors: int, _world: object) -> Driver:
        return HostedVut(corridors, spec, options)

    return Vut(
        make=make,
        max_corridors=facts.max_corridors,
        max_workers=facts.max_workers,
        files=tuple(map(Path, facts.files)),
        data=tuple(map(Path, facts.data)),
    )


def _first(opened: Callable[[], Host]) -> Host:
    """Open a VUT for the first time; where its process dies, again, until the VUT is to blame."""
    blame = Blame[None]()
    while True:
        try:
            return opened()
        except HostDiedError as died:
            if blame.died(None, alone=True, repeatable=died.hung, killed=died.killed):
                raise UserError(died.reason) from died


class HostDiedError(Exception):
    """The process is gone, or was killed because it hung, for a reason.

    `corridor` is that of the controller that was being called, None where it is unknown; `killed`
    says whether SIGKILL ended it, from outside or from within.
    """

    def __init__(
        self, reason: str, corridor: int | None, *, hung: bool = False, killed: bool = False
    ) -> None:
        super().__init__(reason)
        self.reason, self.corridor, self.hung, self.killed = reason, corridor, hung, killed


class Host:
    """The process of a VUT, with the VUT opened in it.

    Attributes:
        alive: whether it can be asked; a process that once gave no answer is killed.
        facts: what the VUT said of itself.
    """

    def __init__(self, spec: VutSpec, options: VutOptions, echo: Echo) -> None:
        """Start the process and open the VUT; `UserError` or `HostDiedError` when that fails."""
        self._spec, self._options, self._echo = spec, options, echo
        self._number = 0
        self.alive = True
        self._buffer = bytearray()
        self._start()
        self.facts = self._open(About.OPEN, Opening(spec, options.deadline_s), Facts)

    def make(self, corridors: int) -> Mapping[str, float]:
        """Have the VUT's driver made, return its parameters; errors as of a new `Host`."""
        return self._open(About.MAKE, corridors, dict[str, wire.Number])

    def ask(self, about: About, content: bytes = b"", *, patience_s: float | None = None) -> Frame:
        """Ask and return the answer; raises `HostDiedError` when there is none.

        The process is killed when one controller is asked for longer than `patience_s`, by default
        that of a step.
        """
        if patience_s is None:
            patience_s = GRACE * self._options.deadline_s + GRACE_S
        self._number += 1
        try:
            wire.write(self._to, wire.frame(self._number, about, content))
            return self._answer(patience_s)
        except (OSError, EOFError):
            raise self._died() from None
        except WireError:
            corridor = self._corridor()
            self.kill()
            raise HostDiedError(how_it_ended(None), corridor) from None
        except BaseException:  # a person stops: the answer is awaited no more
            self.kill()
            raise

    def kill(self) -> None:
        """End the process, and what it started."""
        if not self.alive:
            return  # what its descriptors were may be others' by now
        self.alive = False
        for descriptor in (self._to, self._from, self._lifeline):
            os.close(descriptor)
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        _end_strays(f"TMPDIR={self._scratch.name}")
        self._output.close()
        self._scratch.cleanup()

    def close(self) -> None:
        """Let the VUT close, then end the process."""
        if self.alive:
            with suppress(HostDiedError, subprocess.TimeoutExpired):
                self.ask(About.CLOSE)
                self._process.wait(ENDING_S)
        self.kill()

    def _start(self) -> None:
        # What is killed leaves its temporary files behind: they are in a folder of ours.
        self._scratch = ScratchFolder()
        their_in, self._to = os.pipe()
        self._from, their_out = os.pipe()
        their_lifeline, self._lifeline = os.pipe()
        with tempfile.TemporaryFile() as memory:
            memory.truncate(BlameCell.FORMAT.size)
            settings = {
                "memory_gib": self._options.memory_gib,
                "lifeline": their_lifeline,
                "blame_cell": memory.fileno(),
            }
            try:
                self._process = subprocess.Popen(
                    python_command(HOSTING, settings),
                    stdin=their_in,
                    stdout=their_out,
                    stderr=subprocess.PIPE,
                    pass_fds=(their_lifeline, memory.fileno()),
                    # The order of sets must not be another one in each run.
                    env={**os.environ, "PYTHONHASHSEED": "0", "TMPDIR": self._scratch.name},
                    start_new_session=True,
                )
            except OSError as error:
                for descriptor in (self._to, self._from, self._lifeline):
                    os.close(descriptor)
                self._scratch.cleanup()
                raise UserError(f"cannot start a process for the VUT: {error.strerror}") from error
            finally:
                for descriptor in (their_in, their_out, their_lifeline):
                    os.close(descriptor)
            self._blame_cell = mmap.mmap(memory.fileno(), BlameCell.FORMAT.size)
        # A question fits into the pipe, unless the process has stopped to listen.
        os.set_blocking(self._to, False)
        assert self._process.stderr is not None, "piped"  # noqa: S101
        self._output = Output(self._process.stderr, self._options.log, self._echo)
        self._poll = select.poll()
        self._poll.register(self._from, select.POLLIN)

    def _open(self, about: About, question: Any, kind: type[T]) -> T:
        """Ask for a VUT to be opened or made."""
        spec, content = self._spec, wire.to_json(question)
        try:
            answer = self.ask(about, content, patience_s=self._options.connect_s)
        except HostDiedError as died:
            line = self._output.last_line()
            printed = f" (it printed: {line})" if line else ""
            died.reason = f"opening the VUT {spec} {died.reason}{printed}: look into the VUT"
            raise
        try:
            if answer.about is About.REFUSED:
                raise UserError(wire.from_json(answer.content, str))
            return wire.from_json(answer.content, kind)
        except WireError:
            self.kill()
            raise UserError(f"the VUT {spec} broke the channel to its process") from None
        except UserError:
            self.kill()
            raise

    def _answer(self, patience_s: float) -> Frame:
        notes, clock = BlameCell.read(self._blame_cell)[0], AwakeClock(2.0 * LOOK_S)
        while True:
            answer = wire.take(self._buffer)
            if answer is not None and answer.number == self._number:
                return answer
            now = BlameCell.read(self._blame_cell)[0]
            if now != notes:
                notes = now
                clock.restart()
            elif clock.elapsed_s() > patience_s:
                corridor = self._corridor()
                self.kill()
                late = f"took longer than {patience_s:g} s"
                if patience_s != self._options.connect_s:
                    late = Deadline(self._options.deadline_s).deadline_exceeded
                raise HostDiedError(late, corridor, hung=True)
            if answer is not None:
                continue  # of a child that the VUT forked
            if self._poll.poll(1e3 * min(LOOK_S, patience_s)):
                part = os.read(self._from, 1 << 16)
                if not part:
                    raise EOFError
                self._buffer += part
            elif self._process.poll() is not None:
                raise EOFError

    def _died(self) -> HostDiedError:
        corridor = self._corridor()
        try:
            code = self._process.wait(ENDING_S)
        except subprocess.TimeoutExpired:
            code = None  # it closed the channel and goes on
        self.kill()
        return HostDiedError(how_it_ended(code), corridor, killed=code == -signal.SIGKILL)

    def _corridor(self) -> int | None:
        corridor = BlameCell.read(self._blame_cell)[1]
        return corridor if corridor >= 0 else None


def _end_strays(inherited: str) -> None:
    """End what the VUT started in a session of its own, by what it inherited (Linux only)."""
    for process in Path("/proc").glob("[0-9]*"):
        with suppress(OSError):  # it is another user's, or just ended
            if inherited.encode() in (process / "environ").read_bytes().split(b"\0"):
                os.kill(int(process.name), signal.SIGKILL)


class HostedVut(Driver):
    """Passes every step on to the process of the VUT."""

    def __init__(self, corridors: int, spec: VutSpec, options: VutOptions) -> None:
        """Start the process and make the VUT's driver there; `UserError` when that cannot be."""
        super().__init__(corridors)
        self._spec, self._options, self._echo = spec, options, Echo()
        self._begun: list[tuple[int, Case]] = []
        self._said = wire.NOTHING
        self._files: set[Path] = set()
        self._parameters: Mapping[str, float] = {}
        self._host = _first(self._started)

    def begin(self, corridor: int, case: Case) -> None:
        """Note that an episode begins; the VUT is told with the next scene."""
        self._begun.append((corridor, case))

    def act(self, scene: Scene) -> FloatArray:
        """Return the VUT's answers; NaN where it has a reason. Raises `VutLostError`."""
        if not self._host.alive:
            try:
                self._host = self._started()
            except HostDiedError as died:
                raise VutLostError(died.reason, killed=died.killed) from died
            except UserError as error:
                self._begun.clear()
                why = dict.fromkeys(range(self.corridors), f"started anew: {error}")
                self._said = Said(reasons=why)
                return np.full(self.corridors, math.nan)
        content = wire.pack_scene(self._begun, scene)
        self._begun.clear()
        try:
            answer = self._host.ask(About.ACT, content)
            if answer.about is About.LOST:
                lost = wire.from_json(answer.content, Lost)
                raise VutLostError(lost.reason, lost.corridor, final=lost.final)
            if answer.about is not About.DONE:
                # Not its driver, but what surrounds it failed: the VUT has changed that.
                self._host.kill()
                raise VutLostError(wire.from_json(answer.content, str), final=True)
            answers, self._said = wire.unpack_answers(answer.content, self.corridors)
        except HostDiedError as died:
            own = died.corridor if (died.corridor or 0) < self.corridors else None
            how = {"final": died.hung, "killed": died.killed}
            raise VutLostError(died.reason, own, **how) from None
        except WireError:
            self._host.kill()
            raise VutLostError(how_it_ended(None)) from None
        return answers

    def signals(self) -> Mapping[int, Left]:
        """Return what the VUT left with its last answers."""
        return self._said.signals

    def wishes(self) -> NDArray[np.int8] | None:
        """Return what the VUT's last answers wish, (K,); None where none of them says."""
        wishes = self._said.wishes
        return None if wishes is None else np.array(wishes, dtype=np.int8)

    def parameters(self) -> Mapping[str, float]:
        """Return the parameters of the VUT, as they were when it was made."""
        return self._parameters

    def reason(self, corridor: int) -> str | None:
        """Return what the VUT did wrong in a corridor."""
        return self._said.reasons.get(corridor)

    def files(self) -> tuple[Path, ...]:
        """Return the files that the VUT has loaded so far."""
        if self._host.alive:
            with suppress(HostDiedError, WireError):
                listed = wire.from_json(self._host.ask(About.FILES).content, list[str])
                self._files |= set(map(Path, listed))
        return tuple(sorted(self._files))

    def close(self) -> None:
        """Let the VUT close and end its process."""
        self._host.close()
        self._echo.close()

    def _started(self) -> Host:
        host = Host(self._spec, self._options, self._echo)
        self._files |= set(map(Path, host.facts.files))
        self._parameters = host.make(self.corridors)
        return host
