"""Samplers that enter the benchmark: loaded by name or file, checked, and watched in a search.

A file is code of a user. It runs in worker processes, and its errors are results of the search.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time
from typing import Any, TypeVar

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

LIMIT_S = 1800.0
"""Seconds that a sampler may take in a search, without simulation, by default."""


@dataclass(frozen=True, slots=True)
class Entrant:
    """A sampler that is to be compared.

    Attributes:
        spec: a name of the registry, or FILE.py:CLASS.
        about: its method, in a line.
        sha256: of the file that defines the class.
        predicts: whether it is given the model of the controller, and so sees motions.
        fault: why it does not enter, in a sentence; None where it does.
    """

    spec: str
    about: str = ""
    sha256: str | None = None
    predicts: bool = False
    fault: str | None = None

    @property
    def label(self) -> str:
        """Its name in a table: without the file."""
        return self.spec.rpartition(":")[2]


def sampler_class(spec: str) -> type[Sampler]:
    """Load a sampler; a file is executed, so only in a worker process.

    Args:
        spec: name of the registry, or FILE.py:CLASS.

    Raises:
        UserError: no such sampler exists.
    """
    source, _, name = spec.rpartition(":")
    if not source.endswith(".py"):
        return SAMPLERS[spec]
    try:
        found = getattr(module_of_file(Path(source)), name, None)
    except (Exception, SystemExit) as error:
        kind = type(error).__name__
        raise UserError(f"cannot load the sampler {spec}: {kind}: {text_of(error)}") from error
    if not (isinstance(found, type) and issubclass(found, Sampler)):
        raise UserError(
            f"{source} has no sampler {name!r}: name a subclass of merge_sumo.samplers.base.Sampler"
        )
    return found


def check_spec(spec: str) -> None:
    """Check that a sampler exists, without loading it.

    Args:
        spec: name of the registry, or FILE.py:CLASS.

    Raises:
        UserError: it is neither a sampler of the registry nor a file.
    """
    source, _, name = spec.rpartition(":")
    if source.endswith(".py") and name.isidentifier() and Path(source).is_file():
        return
    if ".py" in spec:
        raise UserError(f"unknown sampler {spec!r}: write FILE.py:CLASS of a file")
    SAMPLERS[spec]


def entrants(specs: Sequence[str], limit_s: float) -> list[Entrant]:
    """Return the samplers of specs; samplers of other packages first pass the contract.

    Args:
        specs: names of the registry, or FILE.py:CLASS.
        limit_s: seconds that the contract may take.
    """
    return [_entrant(spec, Watch(limit_s)) for spec in specs]


def _entrant(spec: str, watch: Watch) -> Entrant:
    fault = None
    try:
        with watch.deadline:
            sampler = watch.call(sampler_class, spec)
            if spec not in SAMPLERS.ours:
                fault = watch.call(violation, sampler)
    except SamplerFaultError as error:
        return Entrant(spec, fault=f"the sampler {spec} cannot be tested: {error}")
    except UserError as error:
        return Entrant(spec, fault=str(error))
    if fault is not None:
        fault = f"the sampler {spec} breaks the contract of samplers: {fault}"
    file = inspect.getsourcefile(sampler)
    sha256 = None if file is None else sha256_of(Path(file))
    return Entrant(spec, text_of(sampler.about), sha256, bool(sampler.uses_predictions), fault)


def lost_entrant(spec: str) -> Entrant:
    """Return the entrant of a sampler that ended its process in the contract.

    Args:
        spec: name of the registry, or FILE.py:CLASS.
    """
    return Entrant(spec, fault=f"the sampler {spec} ends its process: run its contract by pytest")


def violation(sampler: type[Sampler]) -> str | None:
    """Test the contract of samplers: three levels and some thirty cases, without SUMO.

    Args:
        sampler: class of the sampler; its exceptions are raised.

    Returns:
        The broken property in a clause; None where the sampler keeps the contract.
    """
    contract = SamplerContract()
    contract.sampler = sampler
    for name in vars(SamplerContract):
        if not name.startswith("test_"):
            continue
        try:
            getattr(contract, name)()
        except AssertionError as error:
            reason = f" ({error})" if str(error) else ""
            return f"not so: {name.removeprefix('test_').replace('_', ' ')}{reason}"
    return None


class SamplerFaultError(Exception):
    """A sampler raised something, took too long, or gave an answer that is not a list of cases."""


class Watch:
    """Counts the time of a sampler's calls, and ends one that takes more than is left.

    Attributes:
        cpu_s: CPU time of this process in the calls, which other programs do not change.
        deadline: to be entered around the calls.
    """

    def __init__(self, limit_s: float) -> None:
        """Take the time that all calls together may take."""
        self.cpu_s, self.deadline = 0.0, Deadline(limit_s)
        self._limit_s = self._left_s = limit_s

    def call(self, function: Callable[..., T], *arguments: Any) -> T:
        """Call a function of the sampler.

        Args:
            function: the function.
            arguments: its arguments.

        Returns:
            Its result.

        Raises:
            SamplerFaultError: it raised an exception, or took too long.
        """
        self.deadline.deadline_s = max(self._left_s, 1e-3)
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
            self._left_s -= perf_counter() - start_s
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
        """Return its own batch size; by default the batch size of the paper's Table II."""
        if type(self._sampler).batch_size is Sampler.batch_size:
            return COMPARED_BATCH
        size = self._watch.call(self._sampler.batch_size)
        if not isinstance(size, int) or size < 1:
            raise SamplerFaultError(f"its batch size is {text_of(size, repr)}: 1 or more is needed")
        return size

    def ask(self, n: int) -> list[Case]:
        """Return the next cases, which are of the pool.

        Args:
            n: number of cases.
        """
        cases = self._watch.call(self._sampler.ask, n)
        if not isinstance(cases, list) or len(cases) != n:
            raise SamplerFaultError(f"its answer is not a list of {n} cases")
        for case in cases:
            if not isinstance(case, Case) or case.level not in self.pool.levels:
                raise SamplerFaultError(f"{text_of(case, repr)[:60]} is not a case of the pool")
            for dimension in self.pool.scenario.dimensions(case.level):
                value = getattr(case, dimension.field)
                if not dimension.low <= value <= dimension.high:
                    raise SamplerFaultError(
                        f"{dimension.field} of a case is {value:g}: the pool has "
                        f"{dimension.low:g} to {dimension.high:g}"
                    )
        return cases

    def prediction(self, position: int) -> Prediction | None:
        """Return the prediction of a case, which returns to the sampler with the outcome.

        Args:
            position: position of the case in the batch, from 0.
        """
        if not self._sampler.uses_predictions:
            return None
        return self._watch.call(self._sampler.prediction, position)

    def tell(
        self, outcomes: Sequence[Outcome], motions: Mapping[int, FloatArray] | None = None
    ) -> None:
        """Tell the sampler outcomes, and motions where it predicts.

        Args:
            outcomes: the outcomes.
            motions: their motions, (T + 1, A, 3), by index.
        """
        seen = motions if self._sampler.uses_predictions else None
        self._watch.call(self._sampler.tell, outcomes, seen)
