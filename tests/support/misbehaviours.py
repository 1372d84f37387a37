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
        repeats: whether two runs give the same bytes.
        refused: whether it is no VUT at all: `reason` is then part of the sentence.
    """

    source: str
    reason: str | None = None
    shared: bool = False
    repeats: bool = True
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
    "os._exit 0": acts("import os; os._exit(0)", "ended its process with exit code 0"),
    "os._exit 1": acts("import os; os._exit(1)", "ended its process with exit code 1"),
    "os._exit 255": acts("import os; os._exit(255)", "ended its process with exit code 255"),
    "sys.exit": acts("import sys; sys.exit(3)", "SystemExit: 3"),
    "sys.exit with a text": acts("import sys; sys.exit('bye')", "SystemExit: bye"),
    "quit": acts("quit()", "SystemExit"),
    "segfault": acts(SEGFAULT, "by signal 11 (SIGSEGV)"),
    "segfault with faulthandler": acts(
        "import faulthandler; faulthandler.enable(); " + SEGFAULT, "(SIGSEGV)"
    ),
    "abort": acts("import os; os.abort()", "by signal 6 (SIGABRT)"),
    "SIGKILL": acts("import os, signal; os.kill(os.getpid(), signal.SIGKILL)", "(SIGKILL)"),
    "SIGTERM": acts("import os, signal; os.kill(os.getpid(), signal.SIGTERM)", "(SIGTERM)"),
    "SIGSTOP": acts("import os, signal; os.kill(os.getpid(), signal.SIGSTOP)", LATE),
    "SIGINT": acts("import os, signal; os.kill(os.getpid(), signal.SIGINT)", "KeyboardInterrupt"),
    "SIGHUP": acts("import os, signal; os.kill(os.getpid(), signal.SIGHUP)", "(SIGHUP)"),
    "SIGIO": acts("import os, signal; os.kill(os.getpid(), signal.SIGIO)", "(SIGIO)"),
    "kills its process group": acts("import os, signal; os.killpg(0, signal.SIGKILL)", "(SIGKILL)"),
    "exec of a program that ends": acts(
        "import os; os.execv('/bin/true', ['true'])", "ended its process with exit code 0"
    ),
    "exec of a program that stays": acts(
        "import os; os.execv('/bin/sleep', ['sleep', '600'])", "by signal 14 (SIGALRM)"
    ),
    "exec of a program that prints for ever": acts(
        "import os; os.execv('/usr/bin/yes', ['yes'])", "by signal 14 (SIGALRM)"
    ),
    "dies while it resets": resets("import os; os._exit(7)", "exit code 7"),
    "segfault while it resets": resets(SEGFAULT, "(SIGSEGV)"),
    "dies in a text": acts(
        """
        class Odd(Exception):
            def __str__(self):
                import os
                os._exit(9)
        raise Odd
        """,
        "exit code 9",
    ),
    "dies in a thread, later": acts(
        "import os, threading; threading.Timer(0.02, os._exit, (4,)).start()",
        "",
        shared=True,
        repeats=False,
    ),
}
HANGS: Final = {
    "loops": acts(FOREVER, LATE),
    "loops and swallows": acts(STUBBORN, LATE),
    "sleeps": acts("import time; time.sleep(60)", LATE),
    "sleeps in native code": acts("import ctypes; ctypes.CDLL(None).sleep(60)", LATE),
    "sleeps and holds the interpreter": acts(HOLDS_THE_GIL, LATE),
    "a sum without end": acts("10 ** 10 ** 8", LATE),
    "a pattern without end": acts("import re; re.match('(a+)+$', 'a' * 60 + 'b')", LATE),
    "waits for itself": acts("import threading; threading.Event().wait()", LATE),
    "a lock twice": acts("import threading; x = threading.Lock(); x.acquire(); x.acquire()", LATE),
    "waits for a pipe": acts("import os; r, w = os.pipe(); os.read(r, 1)", LATE),
    "hangs while it resets": resets(FOREVER, f"reset: {LATE}"),
    "hangs and swallows while it resets": resets(STUBBORN, LATE),
    "ignores SIGALRM": acts(
        "import signal, time; signal.signal(signal.SIGALRM, signal.SIG_IGN); time.sleep(60)", LATE
    ),
    "cancels the timer": acts(
        "import signal, time; signal.setitimer(signal.ITIMER_REAL, 0); time.sleep(60)", LATE
    ),
    "blocks all signals": acts(
        "import signal, time; "
        "signal.pthread_sigmask(signal.SIG_BLOCK, signal.valid_signals()); time.sleep(60)",
        LATE,
    ),
    "a thread holds the interpreter": acts(
        f"""
        import threading, time
        def hold():
            {HOLDS_THE_GIL}
        threading.Thread(target=hold, daemon=True).start()
        time.sleep(0.05)
        """,
        LATE,
    ),
    "a text that hangs": acts(
        f"""
        class Odd(Exception):
            def __str__(self):
                {FOREVER}
        raise Odd
        """,
        LATE,
    ),
    "a number that hangs": acts(
        f"""
        class Odd(float):
            def __float__(self):
                {FOREVER}
        return Odd(1.0)
        """,
        LATE,
    ),
    "a repr that hangs": acts(
        f"""
        class Odd:
            def __repr__(self):
                {FOREVER}
        return Odd()
        """,
        LATE,
    ),
    "an event loop that hangs": acts("import asyncio; asyncio.run(asyncio.sleep(60))", LATE),
}
MEMORY: Final = {
    "a terabyte": acts("x = bytearray(10 ** 12)", "MemoryError"),
    "a terabyte of numpy": acts("import numpy as np; x = np.ones(10 ** 12)", "MemoryError"),
    "a list that grows": acts(
        """
        import numpy as np
        x = []
        while True:
            x.append(np.empty(1 << 21))
        """,
        "MemoryError",
    ),
    "recursion": acts("f = lambda: f(); f()", "RecursionError"),
    "recursion in native code": acts(
        """
        x = []
        for _ in range(100_000):
            x = [x]
        repr(x)
        """,
        "RecursionError",
    ),
    "recursion in native code without a limit": acts(
        "hash(nest)", "(SIGSEGV)", setup="nest = ()\nfor _ in range(200_000): nest = (nest,)"
    ),
    "recursion without a limit": acts(
        "import sys; sys.setrecursionlimit(10 ** 9); f = lambda: f(); f()", "", repeats=False
    ),
    "a limit of recursion too low": acts(
        """
        import sys
        sys.setrecursionlimit(len(__import__("inspect").stack()) + 10)
        f = lambda n: n and f(n - 1)
        f(60)
        """,
        "RecursionError",
        shared=True,
    ),
    "no memory left for itself": acts(
        """
        import resource
        resource.setrlimit(resource.RLIMIT_AS, (1 << 20, 1 << 20))
        x = bytearray(1 << 26)
        """,
        "",
        shared=True,
        repeats=False,
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
    "no processor time": acts(
        "import resource; resource.setrlimit(resource.RLIMIT_CPU, (1, 1))" + STUBBORN,
        "",
        repeats=False,
    ),
}
PROCESSES: Final = {
    "forks": acts("import os; os.fork() or os._exit(0)"),
    "forks and comes back twice": acts("import os; os.fork()"),
    "forks and ends": acts("import os; os.fork() and os._exit(3)", "exit code 3"),
    "forks and leaves a child": acts("import os, time; os.fork() or time.sleep(600)"),
    "forks more than once": acts("import os; [os.fork() for _ in range(2)]"),
    "forks while it resets": resets("import os; os.fork()"),
    "a subprocess that is left behind": acts(
        "import subprocess; subprocess.Popen(['sleep', '600'])"
    ),
    "a subprocess in a session of its own": acts(
        "import subprocess; subprocess.Popen(['sleep', '600'], start_new_session=True)"
    ),
    "a subprocess that dies": acts("import subprocess; subprocess.run(['false'])"),
    "a subprocess that prints": acts("import subprocess; subprocess.run(['echo', 'hello'])"),
    "a subprocess that hangs": acts("import subprocess; subprocess.run(['sleep', '60'])", LATE),
    "no such program": acts(
        "import subprocess; subprocess.run(['no-such-program'])", "FileNotFoundError"
    ),
    "a pool that is left open": acts(
        "global pool; pool = multiprocessing.get_context('fork').Pool(2)",
        setup="import multiprocessing.pool",
    ),
    "a thread that dies": acts("import threading; threading.Thread(target=lambda: 1 / 0).start()"),
    "a thread that hangs": acts(
        "import threading, time; threading.Thread(target=time.sleep, args=(600,)).start()"
    ),
    "a daemon that hangs": acts(
        "import threading, time\n"
        "threading.Thread(target=time.sleep, args=(600,), daemon=True).start()"
    ),
    "a thread that prints": acts(
        """
        import threading
        def talk():
            for _ in range(2000):
                print("hello")
        threading.Thread(target=talk).start()
        """
    ),
    "twenty threads": acts(
        "import threading, time\n"
        "for _ in range(20): threading.Thread(target=time.sleep, args=(600,)).start()"
    ),
    "a pool of threads": acts(
        "from concurrent.futures import ThreadPoolExecutor\n"
        "global pool; pool = ThreadPoolExecutor(4); pool.submit(abs, 1).result()"
    ),
    "an event loop": acts("import asyncio; asyncio.run(asyncio.sleep(0))"),
    "interrupts the main thread": acts(
        "import _thread; _thread.interrupt_main(); [0 for _ in range(9)]", "KeyboardInterrupt"
    ),
}
RAISES: Final = {
    "a BaseException": acts("raise BaseException('odd')", "BaseException: odd"),
    "a KeyboardInterrupt": acts("raise KeyboardInterrupt", "KeyboardInterrupt"),
    "a GeneratorExit": acts("raise GeneratorExit", "GeneratorExit"),
    "a StopIteration": acts("next(iter(()))", "StopIteration"),
    "a CancelledError": acts("import asyncio; raise asyncio.CancelledError", "CancelledError"),
    "a group": acts("raise ExceptionGroup('g', [ValueError(1)] * 3)", "ExceptionGroup: g"),
    "what stops the program": acts(
        "from merge_sumo.system.interrupt import Stopped; raise Stopped(2)", "Stopped: SIGINT"
    ),
    "what is ours": acts(
        "from merge_sumo.drivers.base import VutLostError; raise VutLostError('mine', 3)",
        "VutLostError: mine",
    ),
    "an error of the user": acts(
        "from merge_sumo.errors import UserError; raise UserError('mine')", "UserError: mine"
    ),
    "the deadline by itself": acts(
        "from merge_sumo.vuts.base import DeadlineExceeded; raise DeadlineExceeded", LATE
    ),
    "an unpicklable exception": acts(
        """
        class Odd(Exception):
            def __init__(self, a, b):
                super().__init__(lambda: a)
        raise Odd(1, 2)
        """,
        "Odd: <function",
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
    "a text that is none": acts(
        """
        class Odd(Exception):
            def __str__(self):
                return 3
        raise Odd
        """,
        "Odd: (TypeError when it was to be shown)",
    ),
    "a text that ends the process": acts(
        """
        class Odd(Exception):
            def __str__(self):
                raise SystemExit(5)
        raise Odd
        """,
        "exit code 5",
    ),
    "a text of 10 MB": acts("raise ValueError('x' * 10_000_000)", "ValueError: " + "x" * 300),
    "a name of 10 MB": acts("raise type('X' * 10_000_000, (Exception,), {})", "X" * 300),
    "a text that is a kind of text": acts(
        """
        class Text(str):
            def __format__(self, how): raise SystemExit
            def __getitem__(self, at): return self
            def __str__(self): return self
        class Odd(Exception):
            def __str__(self):
                return Text("odd")
        raise Odd
        """,
        "Odd: odd",
    ),
    "a class that raises": acts(
        """
        class Odd(Exception):
            @property
            def __class__(self):
                return 1 / 0
        raise Odd("odd")
        """,
        "",
    ),
    "its own cause": acts("e = ValueError('round'); e.__cause__ = e; raise e", "ValueError: round"),
    "control characters": acts(
        "raise ValueError('\\x1b[31mred\\x1b[0m\\0\\r\\n\\x07')",
        r"ValueError: \x1b[31mred\x1b[0m\x00\r\n\x07",
    ),
    "lone surrogates": acts("raise ValueError('\\ud800')", r"ValueError: \ud800"),
    "markup": acts("raise ValueError('</script><b>&')", "ValueError: </script><b>&"),
    "a formula": acts("raise ValueError('=1+1')", "ValueError: =1+1"),
    "an address": acts("raise ValueError(object())", "<object object at 0x...>"),
    "an address in an answer": acts("return lambda: 1", "<function"),
    "its process": acts("import os; raise ValueError(os.getpid())", "ValueError: ", repeats=False),
    "the time": acts("import time; raise ValueError(time.time())", "ValueError: ", repeats=False),
    "a warning as an error": acts(
        "import warnings; warnings.simplefilter('error'); warnings.warn('mind')",
        "UserWarning: mind",
    ),
    "a deep traceback": acts(
        """
        import sys
        sys.setrecursionlimit(200_000)
        def down(n):
            if n == 0: raise ValueError("deep")
            down(n - 1)
        down(20_000)
        """,
        "ValueError: deep",
    ),
}
ANSWERS: Final = {
    f"answers {answer}": acts(f"return {answer}", reason, setup="import numpy as np")
    for answer, reason in {
        "float('nan')": "answered nan",
        "float('inf')": "answered inf",
        "-float('inf')": "answered -inf",
        "None": "answered None (NoneType)",
        "'1.0'": "answered '1.0' (str)",
        "b'1.0'": "answered b'1.0' (bytes)",
        "True": "answered True (bool)",
        "np.True_": "(bool",
        "1 + 2j": "answered (1+2j) (complex)",
        "10 ** 400": "OverflowError",
        "__import__('decimal').Decimal(1)": "(Decimal)",
        "__import__('fractions').Fraction(1)": "(Fraction)",
        "[1.0]": "answered [1.0] (list)",
        "np.ones(1)": "(ndarray)",
        "np.ones(10 ** 6)": "(ndarray)",
        "np.array('1.0')": "(ndarray)",
        "np.array(1.0, dtype=object)": "(ndarray)",
        "np.datetime64('now')": "(datetime64)",
        "(x for x in ())": "<generator object",
        "type('Odd', (), {'__float__': lambda s: 1.0})()": "(Odd)",
        "type('Odd', (float,), {'__float__': lambda s: 1 / 0})(1.0)": "ZeroDivisionError",
        "type('Odd', (), {'__repr__': lambda s: 1 / 0})()": "(ZeroDivisionError when",
        "type('Odd', (), {'__repr__': lambda s: 'x' * 10 ** 7})()": "answered xxx",
        "np.array(float('nan'))": "answered nan",
        "np.float32('inf')": "answered inf",
        "(1.0, float('nan'))": "wishes nan (float)",
        "(1.0, 'yes')": "wishes 'yes' (str)",
        "(1.0, True, 1)": "answered (1.0, True, 1) (tuple)",
        "(True, True)": "answered True (bool)",
        "type('Odd', (tuple,), {'__len__': lambda s: 1 / 0})()": "ZeroDivisionError",
    }.items()
}
HARMLESS: Final = {
    f"answers {answer}": acts(f"return {answer}", setup="import numpy as np")
    for answer in (
        "1",
        "np.array(1.0)",
        "np.float16(1.0)",
        "np.int8(1)",
        "np.longdouble(1)",
        "type('Odd', (float,), {'__repr__': lambda s: 1 / 0})(1.0)",
        "type('Odd', (int,), {})(1)",
    )
}
PRINTS: Final = {
    "prints 10 MB": acts("print('x' * 10_000_000)"),
    "prints many lines": acts("for i in range(20_000): print(i)"),
    "prints bytes": acts("import sys; sys.stdout.buffer.write(bytes(range(256)) * 99)"),
    "prints colours": acts("print('\\x1b[2J\\x1b]0;title\\x07')"),
    "prints NUL": acts("print('\\0' * 1000)"),
    "prints surrogates": acts("print('\\ud800')"),
    "writes to descriptor 1": acts("import os; os.write(1, b'hello')"),
    "writes to descriptor 2": acts("import os; os.write(2, b'hello')"),
    "writes to the first standard output": acts("import sys; print('x', file=sys.__stdout__)"),
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
    "writes a long frame": acts(
        """
        import os, struct
        for descriptor in range(3, 64):
            try:
                os.write(descriptor, struct.pack("<IIB", 2**32 - 1, 1, 10))
            except OSError:
                pass
        """,
        "broke the channel to its process",
    ),
    "reads standard input": acts("import sys; assert sys.stdin.read() == ''"),
    "asks a person": acts("input('your name? ')", "EOFError"),
    "closes standard output": acts("import sys; sys.stdout.close()"),
    "takes standard output away": acts("import sys; sys.stdout = sys.stderr = None"),
    "closes descriptors 0 to 2": acts("import os; os.closerange(0, 3)"),
    "closes all other descriptors": acts("import os; os.closerange(3, 4096)", "exit code 1"),
    "closes all descriptors": acts("import os; os.closerange(0, 4096)", "exit code 1"),
    "puts its log everywhere": acts(
        "import os\nfor d in range(3, 64): os.dup2(2, d)", "exit code 1"
    ),
    "puts nothing everywhere": acts(
        "import os\nn = os.open('/dev/null', 2)\nfor d in range(64): os.dup2(n, d)", ""
    ),
}
CHANGES: Final = {
    "changes directory": acts("import os; os.chdir('/')"),
    "changes directory to one that goes": acts(
        "import os, tempfile; d = tempfile.mkdtemp(); os.chdir(d); os.rmdir(d)"
    ),
    "changes the umask": acts("import os; os.umask(0o777)"),
    "changes the locale": acts("import locale; locale.setlocale(locale.LC_ALL, 'C')"),
    "clears the environment": acts("import os; os.environ.clear()"),
    "changes the temporary folder": acts("import tempfile; tempfile.tempdir = '/nowhere'"),
    "leaves temporary files": acts("import tempfile; tempfile.mkstemp(); tempfile.mkdtemp()"),
    "seeds": acts("import random, numpy as np; random.seed(0); np.random.seed(0)"),
    "numpy raises": acts("import numpy as np; np.seterr(all='raise')"),
    "numpy prints otherwise": acts("import numpy as np; np.set_printoptions(precision=1)"),
    "ignores SIGTERM": acts("import signal; signal.signal(signal.SIGTERM, signal.SIG_IGN)"),
    "ignores SIGIO": acts("import signal; signal.signal(signal.SIGIO, signal.SIG_IGN)"),
    "handles SIGALRM": acts("import signal; signal.signal(signal.SIGALRM, lambda *_: 1 / 0)"),
    "an alarm of its own": acts(
        "import signal; signal.signal(signal.SIGALRM, signal.SIG_DFL); signal.alarm(1)",
        shared=True,
        repeats=False,
    ),
    "rings all the time": acts(
        """
        import signal
        def ring(*_): raise ValueError("ring")
        signal.signal(signal.SIGVTALRM, ring)
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.001, 0.001)
        """,
        "",
        shared=True,
        repeats=False,
    ),
    "traces": acts("import sys; sys.settrace(lambda *_: None)"),
    "traces and raises": acts(
        "import sys; sys.settrace(lambda *_: 1 / 0)", "", shared=True, repeats=False
    ),
    "profiles and raises": acts(
        "import sys; sys.setprofile(lambda *_: 1 / 0)", "", shared=True, repeats=False
    ),
    "collects no garbage": acts("import gc; gc.disable(); x = []; x.append(x)"),
    "collects garbage all the time": acts("import gc; gc.set_threshold(1)"),
    "an audit hook that raises": acts(
        """
        import sys
        def hook(event, arguments):
            if event == "open": raise ValueError("no")
        sys.addaudithook(hook)
        """
    ),
    "an excepthook that hangs": acts(
        "import sys, time; sys.excepthook = lambda *_: time.sleep(60); raise ValueError('x')",
        "ValueError: x",
    ),
    "hangs at exit": acts("import atexit, time; atexit.register(time.sleep, 600)"),
    "dies at exit": acts("import atexit, os; atexit.register(os._exit, 3)"),
    "close that hangs": acts("", methods=f"def close(self):\n    {FOREVER}"),
    "close that swallows": acts("", methods="def close(self):\n" + indent(STUBBORN, "    ")),
    "close that raises": acts("", methods="def close(self):\n    raise BaseException"),
    "close that dies": acts("", methods="def close(self):\n    __import__('os')._exit(3)"),
    "a finaliser that raises": acts("", methods="def __del__(self):\n    1 / 0"),
    "changes what it sees": acts("seen.t_s = 5.0", "AttributeError"),
    "keeps what it sees": acts("global kept; kept = [seen] * 1000"),
    "limits its files": acts("import resource; resource.setrlimit(resource.RLIMIT_NOFILE, (0, 0))"),
    "limits the size of files": acts(
        "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))"
    ),
    "is made once only": acts(
        "raise ValueError('first')",
        "ValueError: first",
        setup="count = 0",
        methods="""
        def __init__(self):
            global count
            count += 1
            if count > 12: raise ValueError("no more")
        """,
        shared=True,
    ),
    "forgets numpy": acts(
        "import sys\nfor n in list(sys.modules):\n    if n.startswith('numpy'): del sys.modules[n]"
    ),
    "forgets all modules": acts("import sys; sys.modules.clear()", shared=True),
    "breaks numpy": acts(
        "import numpy as np; np.array = np.isfinite = np.flatnonzero = lambda *_: 1 / 0",
        "",
        shared=True,
    ),
    "breaks json": acts("import json; json.dumps = lambda *_: 1 / 0; raise ValueError(1)", ""),
    "breaks os.write": acts("import os; os.write = lambda *_: 1 / 0", "", shared=True),
    "swallows os.write": acts("import os; os.write = lambda d, b: len(b)", LATE, shared=True),
    "breaks os.read": acts("import os; os.read = lambda *_: 1 / 0", None, shared=True),
    "breaks the clock": acts("import time; time.perf_counter = time.monotonic = lambda: 0.0"),
    "breaks struct": acts("import struct; struct.pack = struct.unpack = None"),
    "breaks float": acts("import builtins; builtins.float = str", "", shared=True),
    "breaks zip": acts("import builtins; builtins.zip = lambda *_, **__: 1 / 0", "", shared=True),
    "breaks isinstance": acts("import builtins; builtins.isinstance = None", "", shared=True),
    "breaks the watch": acts(
        "from merge_sumo.vuts import base; base.Deadline.call = lambda *_: 1 / 0", "", shared=True
    ),
    "blames another": acts(
        "from merge_sumo.vuts import base; import os; base.asked.note(1); os._exit(3)",
        "exit code 3",
    ),
    "blames nobody there is": acts(
        "from merge_sumo.vuts import base; import os; base.asked.note(77); os._exit(3)",
        "exit code 3",
    ),
    "imports libsumo": acts("libsumo.isLoaded()", setup="import libsumo"),
    "starts SUMO": acts(
        "libsumo.start(['sumo', '-c', '/nothing.sumocfg'])", "", setup="import libsumo"
    ),
    "calls a TraCI server that is not there": acts(
        "traci.connect(1, numRetries=0)", "FatalTraCIError", setup="import traci"
    ),
    "removes its own file": acts("import os; os.remove(__file__)", shared=True, repeats=False),
    "changes its own file": acts("open(__file__, 'a').write('# more')", shared=True, repeats=False),
}
OTHERS: Final = {
    "batched: dies": batched("import os; os._exit(3)", "exit code 3"),
    "batched: segfault": batched(SEGFAULT, "(SIGSEGV)"),
    "batched: loops": batched(FOREVER, LATE),
    "batched: loops and swallows": batched(STUBBORN, LATE),
    "batched: raises": batched("1 / 0", "ZeroDivisionError"),
    "batched: a BaseException": batched("raise BaseException('odd')", "BaseException: odd"),
    "batched: another shape": batched("return answer[:-1]", "shape"),
    "batched: None": batched("return None", "shape ()"),
    "batched: texts": batched("return answer.astype(str)", "shape"),
    "batched: objects": batched("return answer.astype(object)", "shape"),
    "batched: complex": batched("return answer + 1j", "shape"),
    "batched: nan for one": batched("answer[bad] = np.nan", "answered nan"),
    "batched: half a wish for one": batched(
        "answer = np.stack([answer, 0.5 * bad])", "wishes 0.5 instead of 1 or 0"
    ),
    "batched: what was given": batched("seen.x_vut_m[:] = 9.0"),
    "batched: an array that hangs": batched(
        f"""
        class Odd:
            def __array__(self, *_, **__):
                {FOREVER}
        return Odd()
        """,
        LATE,
    ),
    "batched: forks": batched("import os; os.fork()"),
    "batched: is broken from then on": batched("self.guilty = None; 1 / 0", "ZeroDivisionError"),
    "function: dies": function("import os; os._exit(3)", "exit code 3"),
    "function: loops": function(FOREVER, LATE),
    "function: loops and swallows": function(STUBBORN, LATE),
    "function: raises": function("1 / 0", "ZeroDivisionError"),
    "function: is a coroutine": Misbehaviour(
        source="async def Vut(seen):\n    return 1.0\n", reason="<coroutine object", shared=True
    ),
    "loading: prints": loads("print('x' * 100_000)"),
    "loading: starts a thread": loads(
        "import threading, time; threading.Thread(target=time.sleep, args=(600,)).start()"
    ),
    "loading: forks": loads("import os; os.fork()"),
    "loading: dies": loads("import os; os._exit(0)", "ended its process with exit code 0"),
    "loading: exits": loads("import sys; sys.exit(0)", "SystemExit"),
    "loading: segfault": loads(SEGFAULT, "(SIGSEGV)"),
    "loading: raises": loads("1 / 0", "ZeroDivisionError"),
    "loading: a BaseException": loads("raise BaseException('odd')", "odd"),
    "loading: an interrupt": loads("raise KeyboardInterrupt", "KeyboardInterrupt"),
    "loading: a terabyte": loads("x = bytearray(10 ** 12)", "MemoryError"),
    "loading: no syntax": loads("def (", "SyntaxError"),
    "making: raises": replace(
        acts("", "cannot be made", methods="def __init__(self): 1 / 0"), refused=True
    ),
    "making: dies": replace(
        acts("", "exit code 3", methods="def __init__(self): __import__('os')._exit(3)"),
        refused=True,
    ),
}
CATALOGUE: Final = {
    **ENDS,
    **HANGS,
    **MEMORY,
    **PROCESSES,
    **RAISES,
    **ANSWERS,
    **HARMLESS,
    **PRINTS,
    **CHANGES,
    **OTHERS,
}
