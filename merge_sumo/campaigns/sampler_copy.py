"""A copy of the sampler `coverage` in a process beside this one, which searches some levels.

What a search proposes follows from what the sampler was told, and not from where it runs: with the
copy, without it, and after its process died, a campaign has the same cases.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Executor, Future
from copy import deepcopy
from typing import Any, Final

from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.coverage import CoverageSampler
from merge_sumo.samplers.greedy import Proposal
from merge_sumo.system.workers import Workers
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.score import Outcome

WORTH_FROM: Final = 200
"""Cases from which the searches take longer than the start of a process, some 2 s."""


def search_on_two_cores(sampler: Sampler, workers: Workers, cases: int) -> None:
    """Let a copy of a sampler search some of the levels of so many cases, where that pays."""
    if isinstance(sampler, CoverageSampler) and len(sampler.pool.levels) > 1:
        beside = workers.start_beside() if cases >= WORTH_FROM else None
        if beside is not None:
            sampler.copy = CopyBeside(sampler, beside)


class CopyBeside:
    """A copy in the one process of an executor; see `SamplerCopy`.

    While the process starts, and after its death, it searches nothing.
    """

    def __init__(self, sampler: CoverageSampler, beside: Executor) -> None:
        """Copy a sampler that was told nothing yet."""
        levels = sampler.pool.levels
        # The last ones take the longest: of three levels the last one takes nearly half the time.
        self.levels: Sequence[int] = levels[len(levels) - len(levels) // 2 :]
        self._beside = beside
        # The executor pickles it later, when the sampler itself may have been told something.
        self._began = self._call(_begin, deepcopy(sampler))
        self._found: Future[dict[int, Proposal]] | None = None
        self._told: list[Future[None] | None] = []
        """What it was told since its last search."""

    def tell(self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None) -> None:
        """Tell the copy outcomes."""
        self._told.append(self._call(_tell, outcomes, motions))

    def pend(self, cases: Sequence[Case]) -> None:
        """Tell the copy which cases run at present."""
        self._told.append(self._call(_pend, cases))

    def begin(self, n: int) -> bool:
        """Have the copy begin to search a batch of `n` cases; return whether it does."""
        if self._began is None or not self._began.done():
            return False
        if self._began.exception() is not None:  # what cannot travel is searched here
            self._began = None
            return False
        self._found = self._call(_search, self.levels, n)
        return self._found is not None

    def proposals(self) -> dict[int, Proposal] | None:
        """Return the batch of each of its levels; None where the process is gone."""
        assert self._found is not None, "it has begun"  # noqa: S101
        try:
            found = self._found.result()
            for told in filter(None, self._told):
                told.result()  # it was told all: else it searches for another campaign
            self._told.clear()
            return found
        except BrokenExecutor:
            self._began = None
            return None

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Future[Any] | None:
        try:
            return self._beside.submit(function, *arguments)
        except BrokenExecutor:
            self._began = None
            return None


_copies: list[CoverageSampler] = []
"""In the process beside: the one copy."""


def _begin(sampler: CoverageSampler) -> None:
    import sklearn.tree  # noqa: F401 (takes a second, and is needed when the first cases are told)

    _copies[:] = [sampler]


def _tell(outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None) -> None:
    _copies[0].tell(outcomes, motions)


def _pend(cases: Sequence[Case]) -> None:
    _copies[0].pend(cases)


def _search(levels: Sequence[int], n: int) -> dict[int, Proposal]:
    return _copies[0].search(levels, n)
