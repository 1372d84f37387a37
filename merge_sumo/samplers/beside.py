"""A copy of a sampler in a process of its own, which searches some levels meanwhile."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future
from copy import deepcopy
from typing import Any, Final

from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.greedy import Proposal
from merge_sumo.scenario.case import Case, FloatArray
from merge_sumo.system.workers import LocalProcesses
from merge_sumo.verdict.score import Outcome

_copies: Final[list[Sampler]] = []
"""The copy, in its process."""


class CopyBeside:
    """Tells the copy what the sampler is told, and asks it; to be closed.

    Proposals of a level follow from what was told alone, so it makes no difference where they are
    made. Where the process is not there, nothing is answered.
    """

    def __init__(self, sampler: Sampler) -> None:
        """Take a sampler that was told nothing."""
        self._process = LocalProcesses(1)
        # It travels some time from now, when the sampler may have been told something.
        self._there: Future[None] = self._process.submit(_keep, deepcopy(sampler))
        self._asked: Future[dict[int, Proposal]] | None = None
        self._told: list[Future[None]] = []

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None) -> None:
        """Tell what the sampler is told."""
        self._told += filter(None, [self._submit("tell", outcomes, motions)])

    def ask(self, levels: Sequence[int], n: int, pending: Sequence[Case]) -> None:
        """Ask for `n` cases of each of some levels; `answer` waits for them.

        Nothing is asked before the process is there: it takes longer to start than to search.
        """
        self._asked = None
        if self._there.done() and self._there.exception() is None:
            self._submit("pend", pending)
            self._asked = self._submit("search", levels, n)

    def answer(self) -> dict[int, Proposal] | None:
        """Return what was asked for; raises what the copy raised when it was told something."""
        if self._asked is None:
            return None
        try:
            while self._told:
                self._told.pop().result()
            return self._asked.result()
        except BrokenExecutor:
            return None

    def _submit(self, method: str, *arguments: Any) -> Future[Any] | None:
        try:
            return self._process.submit(_do, method, *arguments)
        except BrokenExecutor:
            return None

    def close(self) -> None:
        """End the process."""
        self._process.shutdown(cancel_futures=True)


def _keep(sampler: Sampler) -> None:
    _copies.append(sampler)


def _do(method: str, *arguments: Any) -> Any:
    return getattr(_copies[0], method)(*arguments)
