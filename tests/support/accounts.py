"""A second account of this machine, for attacks by another user.

It is made for a test run and removed behind it, which needs root: `pytest` without skips those
tests and says so.
"""

from __future__ import annotations

import json
import os
import pwd
import signal
import subprocess
import time
import uuid
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

BUSY = 1
"""Exit code of useradd where another process changes the accounts."""


@dataclass(frozen=True)
class Account:
    """A user of this machine who is not the one of the tests."""

    name: str
    uid: int
    gid: int

    def __call__(self, attack: Callable[..., Any], *arguments: Any) -> Any:
        """Return the JSON that a function returns that runs as this user; OSError if it raises."""
        read, write = os.pipe()
        child = self._fork()
        if child == 0:
            self._become()
            try:
                said = {"returned": attack(*arguments)}
            except BaseException as error:
                said = {"raised": repr(error)}
            with os.fdopen(write, "w") as pipe:
                json.dump(said, pipe)
            os._exit(0)
        os.close(write)
        with os.fdopen(read) as pipe:
            said = json.load(pipe)
        os.waitpid(child, 0)
        if "raised" in said:
            raise OSError(said["raised"])
        return said["returned"]

    @contextmanager
    def meanwhile(self, attack: Callable[..., Any], *arguments: Any) -> Iterator[None]:
        """Repeat a function as this user, whatever it raises, until the block ends."""
        child = self._fork()
        if child == 0:
            self._become()
            while True:
                try:
                    attack(*arguments)
                except OSError:
                    time.sleep(0)
        try:
            yield
        finally:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)

    def _fork(self) -> int:
        with (
            warnings.catch_warnings()
        ):  # other threads of ours are no matter: nothing waits for them
            warnings.simplefilter("ignore", DeprecationWarning)
            return os.fork()

    def _become(self) -> None:
        os.setgroups([])
        os.setgid(self.gid)
        os.setuid(self.uid)


@contextmanager
def second_account() -> Iterator[Account]:
    """Make a second account, and remove it in the end; OSError where that cannot be."""
    name = f"ms-{uuid.uuid4().hex[:12]}"
    _change(["useradd", "--no-create-home", name])
    entry = pwd.getpwnam(name)
    try:
        yield Account(name, entry.pw_uid, entry.pw_gid)
    finally:
        _change(["userdel", name])


def _change(command: list[str]) -> None:
    for _ in range(50):
        done = subprocess.run(command, capture_output=True, check=False)
        if done.returncode == 0:
            return
        if done.returncode != BUSY:
            break
        time.sleep(0.2)
    raise OSError(f"{command[0]}: {done.stderr.decode().strip()}")
