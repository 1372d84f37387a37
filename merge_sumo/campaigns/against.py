"""A campaign against an earlier version of the VUT: what does the new one fail that passed before?

Each case runs with both versions. The sampler is told the margin of a regression (`regression`), so
it searches for cases that the new version alone fails. `outcomes.jsonl` of the campaign has the
outcomes of the new version. Those of the earlier one, in the same cases, are in a folder of the
campaign that is a campaign's itself:

against/            campaign.json, outcomes.jsonl, trajectories/ of the earlier version

There `foretold` is what was predicted of the regression.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Final

from merge_sumo.campaigns.prefetch import RunChunks
from merge_sumo.campaigns.store import Batch, Run
from merge_sumo.engine.evaluate import CaseResult
from merge_sumo.errors import UserError
from merge_sumo.samplers.base import Sampler
from merge_sumo.twin.pair import TwinPair
from merge_sumo.values.case import Case
from merge_sumo.values.prediction import Prediction
from merge_sumo.values.regression import regression
from merge_sumo.values.score import Outcome

AGAINST: Final = "against"
"""Folder of the earlier version, and the key of `campaign.json` that names that."""

FIRST_BATCH: Final = 5
"""Cases of each level in the first batch where twins predict, which they do from four cases on.
Measured with design2 and design2?x1_m=120 at level 2, seeds 0 to 4: after 40 cases .81 of what
broke is found in the median, and .69 with ten.
"""

BothBatches = tuple[Batch, Batch]
"""The same cases with the new version and with the earlier one."""


class PairedSearch:
    """Asks a sampler for cases, runs each with both versions, and tells it the regressions."""

    def __init__(
        self,
        sampler: Sampler,
        twins: TwinPair | None,
        stop: Callable[[Sequence[Outcome]], bool] | None = None,
    ) -> None:
        """Take a sampler that was told nothing, and its predictor if it has one.

        `stop` says of the regressions so far whether the search is over.
        """
        self._sampler, self._twins, self._stop = sampler, twins, stop

    def tell(self, new: Batch, old: Batch) -> None:
        """Tell the sampler what both versions did in the same cases, in order."""
        if self._twins is not None:
            motions = {outcome.index: trajectory.motion for outcome, trajectory in old}
            self._twins.tell_old([outcome for outcome, _ in old], motions)
        self._sampler.tell(
            [regression(n, o, o.prediction) for (n, _), (o, _) in zip(new, old, strict=True)],
            {outcome.index: trajectory.motion for outcome, trajectory in new},
        )

    def batches(
        self,
        run_new: Callable[[Sequence[Case]], Iterable[tuple[int, CaseResult]]],
        run_old: Callable[[Sequence[Case]], Iterable[tuple[int, CaseResult]]],
        *,
        cases: int,
        batch: int | None,
        last: Outcome | None = None,
        on_case: Callable[[Outcome], None] | None = None,
    ) -> Iterator[BothBatches]:
        """Yield batches, in order, until there are so many cases.

        Args:
            run_new: runs cases with the new version; gives (place, result) in any order.
            run_old: the same with the earlier version.
            cases: number of cases after which the search ends.
            batch: cases of a batch; by default as many as the sampler wants.
            last: the last outcome that the search was told.
            on_case: called with every outcome of the new version.
        """
        sampler = self._sampler
        number, first = (0, 0) if last is None else (last.batch + 1, last.index + 1)
        while first < cases and not (self._stop is not None and self._stop(sampler.observed())):
            proposed = sampler.ask(min(batch or self._batch_size(first), cases - first))
            foretold = [sampler.prediction(place) for place in range(len(proposed))]
            unknown = [None] * len(proposed)
            # The simulator of the version that ran last is still open.
            if number % 2:
                new = _batch(run_new(proposed), first, number, unknown, on_case)
            old = _batch(run_old(proposed), first, number, foretold)
            if not number % 2:
                new = _batch(run_new(proposed), first, number, unknown, on_case)
            self.tell(new, old)
            yield new, old
            number, first = number + 1, first + len(proposed)

    def _batch_size(self, ran: int) -> int:
        """Return the size of the next batch, after so many cases."""
        size = self._sampler.batch_size()
        if ran or self._twins is None:
            return size
        return min(size, FIRST_BATCH * len(self._sampler.pool.levels))


def _batch(
    results: Iterable[tuple[int, CaseResult]],
    first: int,
    number: int,
    predictions: Sequence[Prediction | None],
    on_case: Callable[[Outcome], None] | None = None,
) -> Batch:
    """Return a batch in the order of its cases."""
    ran: Batch = []
    for place, result in results:
        outcome = result.outcome(first + place, number, predictions[place])
        ran.append((outcome, result.trajectory))
        if on_case is not None:
            on_case(outcome)
    return sorted(ran, key=lambda pair: pair[0].index)


def by_batch(
    run_chunks: RunChunks, chunk_size: Callable[[int], int]
) -> Callable[[Sequence[Case]], Iterator[tuple[int, CaseResult]]]:
    """Return what runs the cases of a batch in chunks, and gives (place, result) in any order."""

    def run(cases: Sequence[Case]) -> Iterator[tuple[int, CaseResult]]:
        size = chunk_size(len(cases))
        chunks = (cases[first : first + size] for first in range(0, len(cases), size))
        for first, results in run_chunks(chunks):
            yield from enumerate(results, start=first)

    return run


def earlier_run(run: Run) -> Run | None:
    """Return the run of the version that a campaign is against, None where it is against none.

    Raises `UserError` where that is missing, or has other cases. Of a campaign that was stopped it
    may have more of them.
    """
    if run.settings.get(AGAINST) is None:
        return None
    earlier = Run(run.folder / AGAINST)
    count = len(run.outcomes)
    if [o.case for o in earlier.outcomes[:count]] != [o.case for o in run.outcomes]:
        raise UserError(
            f"{earlier.folder} has other cases than {run.folder}: take both from a copy, or run "
            "the campaign again"
        )
    return earlier
