"""A catalogue of what a user's VUT may do to the process that it is in, by name.

Each source drives by the law of level 0, and does what its name says in the guilty cases: those in
which the POV is faster than `GUILTY_MPS`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from textwrap import dedent, indent
from typing import Final

GUILTY_MPS: Final = 34.0
DEADLINE_S: Final = 0.3
LATE: Final = f"took longer than the deadline of {DEADLINE_S} s"


@dataclass(frozen=True, kw_only=True)
class Misbehaviour:
    """A source of a VUT and what becomes of its guilty cases.

    Attributes:
        source: of a module with the VUT `Vut`.
        reason: part of the `error` of a guilty case; None where it ends as if nothing had been.
        shared: whether it changes what all episodes of its process share, so that others of them
            may err, too, and others again with other workers.
        refused: whether it is no VUT at all: `reason` is then part of the sentence.
    """

    source: str
    reason: str | None = None
    shared: bool = False
    refused: bool = False


CLASS: Final = """
class Vut:
    def reset(self, seen):
        self.guilty = seen.v_pov_mps > {limit}
        if self.guilty:
{reset}
    def act(self, seen):
        if self.guilty and seen.t_s == 0.3:
{act}
        return min(max((28.0 - seen.v_vut_mps) / 0.1, 0.0), 1.0)
{methods}
"""
BATCHED: Final = """
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
FUNCTION: Final = """
def Vut(seen):
    if seen.v_pov_mps > {limit} and seen.t_s == 0.3:
{act}
    return min(max((28.0 - seen.v_vut_mps) / 0.1, 0.0), 1.0)
"""


def code(text: str, spaces: int) -> str:
    return indent(dedent(text).strip() or "pass", " " * spaces)


def acts(
    body: str, reason: str | None = None, setup: str = "", reset: str = "", methods: str = "", **how
) -> Misbehaviour:
    """Return a class that does it while it acts."""
    source = CLASS.format(
        limit=GUILTY_MPS, act=code(body, 12), reset=code(reset, 12), methods=code(methods, 4)
    )
    return Misbehaviour(source=dedent(setup) + source, reason=reason, **how)


def resets(body: str, reason: str | None = None, **how) -> Misbehaviour:
    return acts("", reason, reset=body, **how)


def batched(body: str, reason: str | None = None, **how) -> Misbehaviour:
    source = BATCHED.format(limit=GUILTY_MPS, act=code(body, 12))
    return Misbehaviour(source=source, reason=reason, **how)


def function(body: str, reason: str | None = None, **how) -> Misbehaviour:
    source = FUNCTION.format(limit=GUILTY_MPS, act=code(body, 8))
    return Misbehaviour(source=source, reason=reason, **how)


def loads(setup: str, reason: str | None = None, **how) -> Misbehaviour:
    """Return a module that does it while it is loaded."""
    return replace(acts("", reason, setup=setup, **how), refused=reason is not None)


SEGFAULT: Final = "import ctypes; ctypes.string_at(0)"
FOREVER: Final = "while True: pass"
STUBBORN: Final = """
while True:
    try:
        while True: pass
    except: pass
"""
"""Swallows what interrupts it."""
HOLDS_THE_GIL: Final = "import ctypes; ctypes.PyDLL(None).sleep(60)"

ENDS: Final = {
    "sys.exit": acts("import sys; sys.exit(3)", "SystemExit: 3"),
    "os._exit 0": acts("import os; os._exit(0)", "ended its process with exit code 0"),
    "segfault": acts(SEGFAULT, "by signal 11 (SIGSEGV)"),
    "SIGKILL": acts("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "(SIGKILL)"),
    "SIGSTOP": acts("import os, signal; os.kill(os.getpid(), signal.SIGSTOP)", LATE),
    "SIGINT": acts("import os, signal; os.kill(os.getpid(), signal.SIGINT)", "KeyboardInterrupt"),
    "kills its process group": acts("import os, signal; os.killpg(0, signal.SIGKILL)", "(SIGKILL)"),
    "exec of a program that stays": acts(
        "import os; os.execv('/bin/sleep', ['sleep', '600'])", "by signal 14 (SIGALRM)"
    ),
    "dies while it resets": resets("import os; os._exit(7)", "exit code 7"),
    "dies in a thread, later": acts(
        "import os, threading; threading.Timer(0.02, os._exit, (4,)).start()",
        "",
        shared=True,
    ),
}
HANGS: Final = {
    "loops": acts(FOREVER, LATE),
    "loops and swallows": acts(STUBBORN, LATE),
    "sleeps and holds the interpreter": acts(HOLDS_THE_GIL, LATE),
    "hangs while it resets": resets(FOREVER, f"reset: {LATE}"),
    "cancels the timer": acts(
        "import signal, time; signal.setitimer(signal.ITIMER_REAL, 0); time.sleep(60)", LATE
    ),
    "blocks all signals": acts(
        "import signal, time; "
        "signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals()); time.sleep(60)",
        LATE,
    ),
}
MEMORY: Final = {
    "a list that grows": acts(
        """
        import numpy as np
        x = []
        while True:
            x.append(np.empty(1 << 21))
        """,
        "MemoryError",
    ),
    "recursion in native code without a limit": acts(
        "hash(nest)", "(SIGSEGV)", setup="nest = ()\nfor _ in range(200_000): nest = (nest,)"
    ),
    "no memory left for itself": acts(
        """
        import resource
        resource.setrlimit(resource.RLIMIT_AS, (1 << 20, 1 << 20))
        x = bytearray(1 << 26)
        """,
        "",
        shared=True,
    ),
    "no descriptors left": acts(
        """
        import os
        while True:
            os.open("/dev/null", os.O_RDONLY)
        """,
        "Too many open files",
        shared=True,
    ),
}
PROCESSES: Final = {
    "forks and comes back twice": acts("import os; os.fork()"),
    "forks and leaves a child": acts("import os, time; os.fork() or time.sleep(600)"),
    "a subprocess that is left behind": acts(
        "import subprocess; subprocess.Popen(['sleep', '600'])"
    ),
    "a subprocess in a session of its own": acts(
        "import subprocess; subprocess.Popen(['sleep', '600'], start_new_session=True)"
    ),
    "a thread that hangs": acts(
        "import threading, time; threading.Thread(target=time.sleep, args=(600,)).start()"
    ),
}
RAISES: Final = {
    "a breakpoint": acts("breakpoint()", "a debugger was left"),
    "a BaseException": acts("raise BaseException('odd')", "BaseException: odd"),
    "what stops the program": acts(
        "from merge_sumo.system.interrupt import Stopped; raise Stopped(2)", "Stopped: SIGINT"
    ),
    "a text that raises": acts(
        """
        class Odd(Exception):
            def __str__(self):
                return 1 / 0
        raise Odd
        """,
        "Odd: (ZeroDivisionError when it was to be shown)",
    ),
    "a text of 10 MB": acts("raise ValueError('x' * 10_000_000)", "ValueError: " + "x" * 300),
    "control characters": acts(
        "raise ValueError('\\x1b[31mred\\x1b[0m\\0\\r\\n\\x07')",
        r"ValueError: \x1b[31mred\x1b[0m\x00\r\n\x07",
    ),
}
ANSWERS: Final = {
    f"answers {answer}": acts(f"return {answer}", reason, setup="import numpy as np")
    for answer, reason in {
        "float('nan')": "answered nan",
        "None": "answered None (NoneType)",
        "10 ** 400": "OverflowError",
        "[1.0]": "answered [1.0] (list)",
        "type('Odd', (), {'__repr__': lambda s: 1 / 0})()": "(ZeroDivisionError when",
        "type('Odd', (tuple,), {'__len__': lambda s: 1 / 0})()": "ZeroDivisionError",
    }.items()
}
HARMLESS: Final = {
    f"answers {answer}": acts(f"return {answer}", setup="import numpy as np")
    for answer in (
        "np.float16(1.0)",
        "type('Odd', (float,), {'__repr__': lambda s: 1 / 0})(1.0)",
    )
}
PRINTS: Final = {
    "prints 10 MB": acts("print('x' * 10_000_000)"),
    "writes to every descriptor": acts(
        """
        import os
        for descriptor in range(3, 64):
            try:
                os.write(descriptor, b"hello" * 20)
            except OSError:
                pass
        """,
        "broke the channel to its process",
    ),
    "writes frames of others": acts(
        """
        import os, struct
        for descriptor in range(3, 64):
            try:
                os.write(descriptor, struct.pack("<IIB", 0, 99999, 10) * 1000)
            except OSError:
                pass
        """
    ),
    "closes all other descriptors": acts("import os; os.closerange(3, 4096)", "exit code 1"),
    "closes all descriptors": acts("import os; os.closerange(0, 4096)", "exit code 1"),
}
CHANGES: Final = {
    "blames another": acts(
        "from merge_sumo.vuts import base; import os; base.current_call.note(1); os._exit(3)",
        "exit code 3",
    ),
    "changes directory": acts("import os; os.chdir('/')"),
    "leaves temporary files": acts("import tempfile; tempfile.mkstemp(); tempfile.mkdtemp()"),
    "ignores SIGTERM": acts("import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)"),
    "an alarm of its own": acts(
        "import signal; signal.signal(signal.SIGALRM, signal.SIG_DFL); signal.alarm(1)",
        shared=True,
    ),
    "traces and raises": acts("import sys; sys.settrace(lambda *_: 1 / 0)", "", shared=True),
    "hangs at exit": acts("import atexit, time; atexit.register(time.sleep, 600)"),
    "close that hangs": acts("", methods=f"def close(self):\n    {FOREVER}"),
    "close that dies": acts("", methods="def close(self):\n    __import__('os')._exit(3)"),
    "forgets all modules": acts("import sys; sys.modules.clear()", shared=True),
    "breaks numpy": acts(
        "import numpy as np; np.array = np.isfinite = np.flatnonzero = lambda *_: 1 / 0",
        "",
        shared=True,
    ),
    "breaks the watch": acts(
        "from merge_sumo.vuts import base; base.Deadline.call = lambda *_: 1 / 0", "", shared=True
    ),
    "removes its own file": acts("import os; os.remove(__file__)", shared=True),
}
OTHERS: Final = {
    "batched: dies": batched("import os; os._exit(3)", "exit code 3"),
    "batched: nan for one": batched("answer[bad] = np.nan", "answered nan"),
    "function: loops and swallows": function(STUBBORN, LATE),
    "function: is a coroutine": Misbehaviour(
        source="async def Vut(seen):\n    return 1.0\n", reason="<coroutine object", shared=True
    ),
    "loading: forks": loads("import os; os.fork()"),
    "loading: dies": loads("import os; os._exit(0)", "ended its process with exit code 0"),
    "loading: an interrupt": loads("raise KeyboardInterrupt", "KeyboardInterrupt"),
    "making: dies": replace(
        acts("", "exit code 3", methods="def __init__(self): __import__('os')._exit(3)"),
        refused=True,
    ),
}
CATALOGUE: Final = (
    ENDS | HANGS | MEMORY | PROCESSES | RAISES | ANSWERS | HARMLESS | PRINTS | CHANGES | OTHERS
)
