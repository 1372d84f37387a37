"""Samplers that enter the benchmark: found by name or file, checked, and watched as they search.

Their code may be anybody's: it runs in worker processes, and what it raises, a call that does not
end and an answer that is none are results of the search.
"""

from __future__ import annotations

import faulthandler
import inspect
import multiprocessing
import os
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, Final, TypeVar

from merge_sumo.analysis.sampler_study import COMPARED_BATCH
from merge_sumo.controllers.deadline import Deadline, DeadlineExceeded, text_of
from merge_sumo.controllers.python import module_of_file
from merge_sumo.errors import UserError
from merge_sumo.files import sha256_of
from merge_sumo.metrics.outcome import Outcome, Prediction
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.contract import SamplerContract
from merge_sumo.samplers.registry import SAMPLERS
from merge_sumo.scenario.case import Case, FloatArray, Pool

T = TypeVar("T")

LIMIT_S: Final = 1800.0
"""Seconds that a sampler may take in a search, without simulation, unless a person says other."""
KILLED_AFTER: Final = 1.2
"""Of the time that is left to a sampler, when its process is ended: native code hears no timer."""
GRACE_S: Final = 5.0
"""Seconds more than that."""


@dataclass(frozen=True, slots=True)
class Entrant:
    """A sampler that is to be compared.

    Attributes:
        spec: a name of the registry, or FILE.py:CLASS.
        about: what it does, in a line.
        colour: of its curves, #RRGGBB.
        sha256: of the file that defines the class.
        predicts: whether it is given the model of the controller, and so sees motions.
        fault: why it does not enter, in a sentence; None where it does.
    """

    spec: str
    about: str = ""
    colour: str = "#7B3294"
    sha256: str | None = None
    predicts: bool = False
    fault: str | None = None

    @property
    def label(self) -> str:
        """Its name in a table: without the file."""
        return self.spec.rpartition(":")[2]


def sampler_class(spec: str) -> type[Sampler]:
    """Return the sampler that a spec names; `UserError` where there is none.

    A file is executed: in a worker process alone.
    """
    source, _, name = spec.rpartition(":")
    if not source.endswith(".py"):
        return SAMPLERS[spec]
    try:
        found = getattr(module_of_file(Path(source)), name, None)
    except OSError as error:
        raise UserError(f"cannot read the sampler {source}: {error.strerror}") from error
    except (Exception, SystemExit) as error:
        raise UserError(
            f"cannot load the sampler {spec}: {type(error).__name__}: {text_of(error)}"
        ) from error
    if not (isinstance(found, type) and issubclass(found, Sampler)):
        raise UserError(
            f"{source} has no sampler {name!r}: name a subclass of merge_sumo.samplers.base.Sampler"
        )
    return found


def check_spec(spec: str) -> None:
    """Raise `UserError` where a spec names nothing that can be looked into; run nothing."""
    source, _, name = spec.rpartition(":")
    if not source.endswith(".py"):
        if spec.endswith(".py"):
            raise UserError(f"{spec} is a file: name a class of it, {spec}:CLASS")
        if spec not in SAMPLERS:
            SAMPLERS[spec]
    elif not (Path(source).is_file() and name.isidentifier()):
        raise UserError(
            f"there is no sampler {spec!r}: write FILE.py:CLASS of a file that is there"
        )


def entrants(specs: Sequence[str], limit_s: float = LIMIT_S) -> list[Entrant]:
    """Return what specs name, each put through the contract of samplers unless it is ours.

    `limit_s` is what the contract may take.
    """
    return [_entrant(spec, limit_s) for spec in specs]


def _entrant(spec: str, limit_s: float) -> Entrant:
    if sys.flags.optimize and spec not in SAMPLERS.ours:
        return Entrant(spec, fault="the contract of samplers is made of assertions: leave -O away")
    watch = Watch(limit_s)
    try:
        with watch.deadline:
            sampler = watch.call(sampler_class, spec)
            broken = None if spec in SAMPLERS.ours else watch.call(violation, sampler)
    except SamplerFaultError as error:
        return Entrant(spec, fault=f"the sampler {spec} cannot be tested: {error}")
    except UserError as error:
        return Entrant(spec, fault=str(error))
    file = inspect.getsourcefile(sampler)
    return Entrant(
        spec,
        text_of(sampler.about),
        text_of(sampler.colour),
        None if file is None else sha256_of(Path(file)),
        bool(sampler.uses_predictions),
        None if broken is None else f"the sampler {spec} breaks the contract of samplers: {broken}",
    )


def lost_entrant(spec: str) -> Entrant:
    """Return what is said of a sampler that ended its process in the contract."""
    return Entrant(spec, fault=f"the sampler {spec} ends its process: run its contract by pytest")


class SamplerFaultError(Exception):
    """A sampler raised something, took too long, or answered with what are no cases."""


class Watch:
    """Counts the time of a sampler's calls, and ends one that takes more than is left.

    Attributes:
        seconds: time spent in calls so far.
        cpu_s: CPU time of this process in them, which other programs do not change.
        deadline: to be entered around the calls.
    """

    def __init__(self, limit_s: float) -> None:
        """Take the time that all calls together may take."""
        self.seconds, self.cpu_s, self.deadline = 0.0, 0.0, Deadline(limit_s)
        self._limit_s = limit_s
        self._is_worker = multiprocessing.parent_process() is not None

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """Return function(*arguments); raise `SamplerFaultError` for what it does wrong."""
        left_s = max(self._limit_s - self.seconds, 1e-3)
        self.deadline.deadline_s = left_s
        if self._is_worker:
            with open(os.devnull, "wb") as nothing:  # noqa: PTH123 (a name of the system)
                return self._killed_if_late(left_s, nothing, function, *arguments)
        return self._timed(function, *arguments)

    def _killed_if_late(
        self, left_s: float, log: Any, function: Callable[..., T], *arguments: Any
    ) -> T:
        late_s = KILLED_AFTER * left_s + GRACE_S
        faulthandler.dump_traceback_later(late_s, exit=True, file=log)
        try:
            return self._timed(function, *arguments)
        finally:
            faulthandler.cancel_dump_traceback_later()

    def _timed(self, function: Callable[..., T], *arguments: Any) -> T:
        start_s, start_cpu_s = perf_counter(), process_time()
        try:
            self.deadline.start()
            answer: T = function(*arguments)
            self.deadline.stop()
        except UserError:
            raise
        except DeadlineExceeded as error:
            raise SamplerFaultError(f"it took longer than {self._limit_s:g} s") from error
        except BaseException as error:
            raise SamplerFaultError(self.deadline.reason(error)) from error
        finally:
            self.seconds += perf_counter() - start_s
            self.cpu_s += process_time() - start_cpu_s
        return answer


class WatchedSampler(Sampler):
    """Another sampler, whose answers are checked and whose faults are `SamplerFaultError`."""

    def __init__(self, make: Callable[[], Sampler], pool: Pool, seed: int, watch: Watch) -> None:
        """Make the sampler."""
        super().__init__(pool, seed)
        self._watch = watch
        self._sampler = watch.call(make)

    def batch_size(self) -> int:
        """Return its own size of a batch; that of the paper's Table II where it states none."""
        if type(self._sampler).batch_size is Sampler.batch_size:
            return COMPARED_BATCH
        size = self._watch.call(self._sampler.batch_size)
        if not isinstance(size, int) or size < 1:
            raise SamplerFaultError(f"its batch size is {text_of(size, repr)}: 1 or more is needed")
        return size

    def ask(self, n: int) -> list[Case]:
        """Return the next cases, which are so many and of the pool."""
        cases = self._watch.call(self._sampler.ask, n)
        if not isinstance(cases, list) or len(cases) != n:
            raise SamplerFaultError(f"asked for {n} cases, it gives {text_of(cases, _in_short)}")
        for case in cases:
            self._check(case)
        return cases

    def _check(self, case: Case) -> None:
        scenario = self.pool.scenario
        if not isinstance(case, Case) or case.level not in self.pool.levels:
            raise SamplerFaultError(
                f"it gives {text_of(case, repr)[:60]}, which is no case of the pool"
            )
        for dimension in scenario.dimensions(case.level):
            value = getattr(case, dimension.field)
            if not dimension.low <= value <= dimension.high:
                raise SamplerFaultError(
                    f"it gives a case with {dimension.field} {value:g}: the pool has "
                    f"{dimension.low:g} to {dimension.high:g}"
                )

    def prediction(self, place: int) -> Prediction | None:
        """Return its prediction, which it is told again with the outcome."""
        if not self._sampler.uses_predictions:
            return None
        return self._watch.call(self._sampler.prediction, place)

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Tell it the outcomes, and the motions where it predicts."""
        seen = motions if self._sampler.uses_predictions else None
        self._watch.call(self._sampler.tell, outcomes, seen)


def _in_short(answer: object) -> str:
    return f"{len(answer)}" if isinstance(answer, list) else type(answer).__name__


def violation(sampler: type[Sampler]) -> str | None:
    """Return in a clause what a sampler does that the contract forbids; None where it keeps it.

    It is a pool of three levels and some thirty cases, without SUMO. What the sampler raises is
    raised.
    """
    contract = SamplerContract()
    contract.sampler = sampler
    for name in vars(SamplerContract):
        if not name.startswith("test_"):
            continue
        try:
            getattr(contract, name)()
        except AssertionError as error:
            said = f" ({error})" if str(error) else ""
            return f"not so: {name.removeprefix('test_').replace('_', ' ')}{said}"
    return None
