"""What a user's VUT may do to the process that it is in, by name: one or two of each kind.

Each source drives by the law of level 0, and does what its name says in the guilty cases: those in
which the POV is faster than `GUILTY_MPS`.
"""

from __future__ import annotations

from dataclasses import dataclass
from textwrap import dedent, indent

GUILTY_MPS = 34.0
DEADLINE_S = 0.3
LATE = f"took longer than the deadline of {DEADLINE_S} s"


@dataclass(frozen=True, kw_only=True)
class Misbehaviour:
    """A source of a VUT and what becomes of its guilty cases.

    Attributes:
        source: of a module with the VUT `Vut`.
        reason: part of the `error` of a guilty case; None where it ends as if nothing had been.
    """

    source: str
    reason: str | None = None


CLASS = """
class Vut:
    def reset(self, seen):
        self.guilty = seen.v_pov_mps > {limit}
    def act(self, seen):
        if self.guilty and seen.t_s == 0.3:
{act}
        return min(max((28.0 - seen.v_vut_mps) / 0.1, 0.0), 1.0)
{methods}
"""
BATCHED = """
import numpy as np
class Vut:
    def __init__(self, corridors):
        self.guilty = np.zeros(corridors, dtype=bool)
    def reset(self, corridor, seen):
        self.guilty[corridor] = seen.v_pov_mps > {limit}
    def act_batch(self, seen):
        answer = np.clip((28.0 - seen.v_vut_mps) / 0.1, 0.0, 1.0)
        bad = self.guilty & seen.active & (seen.t_s == 0.3)
        if bad.any():
{act}
        return answer
"""


def code(text: str, spaces: int) -> str:
    return indent(dedent(text).strip() or "pass", " " * spaces)


def acts(body: str, reason: str | None = None, methods: str = "") -> Misbehaviour:
    """Return a class that does it while it acts."""
    source = CLASS.format(limit=GUILTY_MPS, act=code(body, 12), methods=code(methods, 4))
    return Misbehaviour(source=source, reason=reason)


def batched(body: str, reason: str | None = None) -> Misbehaviour:
    source = BATCHED.format(limit=GUILTY_MPS, act=code(body, 12))
    return Misbehaviour(source=source, reason=reason)


STUBBORN = """
while True:
    try:
        while True: pass
    except: pass
"""
"""Swallows what interrupts it."""

CATALOGUE = {
    "segfault": acts("import ctypes; ctypes.string_at(0)", "by signal 11 (SIGSEGV)"),
    "sleeps and holds the interpreter": acts("import ctypes; ctypes.PyDLL(None).sleep(60)", LATE),
    "a list that grows": acts(
        """
        import numpy as np
        x = []
        while True:
            x.append(np.empty(1 << 21))
        """,
        "MemoryError",
    ),
    "forks and comes back twice": acts("import os; os.fork()"),
    "a subprocess": acts("import subprocess; subprocess.Popen(['sleep', '600'])"),
    "a text of 10 MB": acts("raise ValueError('x' * 10_000_000)", "ValueError: " + "x" * 300),
    "an answer that cannot be shown": acts(
        "return type('Odd', (), {'__repr__': lambda s: 1 / 0})()", "(ZeroDivisionError while"
    ),
    "writes into all descriptors": acts(
        """
        import os
        for descriptor in range(3, 64):
            try:
                os.write(descriptor, bytes(1000))
            except OSError:
                pass
        """,
        "broke the connection to its process",
    ),
    "closes all descriptors": acts("import os; os.closerange(0, 4096)", "exit code 1"),
    "changes directory": acts("import os; os.chdir('/')"),
    "close that hangs": acts("", methods="def close(self):\n    while True: pass"),
    "batched: dies": batched("import os; os._exit(3)", "exit code 3"),
}
