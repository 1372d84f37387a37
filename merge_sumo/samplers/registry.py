"""The samplers by their names on the command line."""

from __future__ import annotations

from typing import TYPE_CHECKING

from merge_sumo.registry import Registry

if TYPE_CHECKING:
    from merge_sumo.samplers.base import Predictor, Sampler
    from merge_sumo.scenario.case import Pool


def _is_sampler(item: object) -> bool:
    from merge_sumo.samplers.base import Sampler

    return isinstance(item, type) and issubclass(item, Sampler)


SAMPLERS: Registry[type[Sampler]] = Registry(
    "merge_sumo.samplers",
    "sampler",
    {
        "uniform": "merge_sumo.samplers.uniform:UniformSampler",
        "annealing": "merge_sumo.samplers.annealing:AnnealingSampler",
        "subset": "merge_sumo.samplers.subset:SubsetSampler",
        "gpr": "merge_sumo.samplers.gpr:GprSampler",
        "coverage": "merge_sumo.samplers.coverage:CoverageSampler",
    },
    accepts=_is_sampler,
    contract="a subclass of merge_sumo.samplers.base.Sampler",
)


def make_sampler(name: str, pool: Pool, seed: int, predictor: Predictor | None = None) -> Sampler:
    """Return a sampler without outcomes.

    Args:
        name: its name in `SAMPLERS`.
        pool: the cases to choose from.
        seed: the same seed gives the same proposals.
        predictor: for samplers that use predictions.

    Raises:
        UserError: no sampler has that name.
    """
    return SAMPLERS[name](pool, seed, predictor)
