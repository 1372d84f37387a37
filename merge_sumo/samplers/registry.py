"""The samplers by the name that a person writes after `--sampler`."""

from __future__ import annotations

from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.samplers.annealing import AnnealingSampler
from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.coverage import CoverageSampler
from merge_sumo.samplers.gpr import GprSampler
from merge_sumo.samplers.prediction_skill import Predictor
from merge_sumo.samplers.subset import SubsetSampler
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.system.suggestions import meant
from merge_sumo.values.case import Pool

SAMPLERS: Final[dict[str, type[Sampler]]] = {
    "uniform": UniformSampler,
    "annealing": AnnealingSampler,
    "subset": SubsetSampler,
    "gpr": GprSampler,
    "coverage": CoverageSampler,
}


def make_sampler(name: str, pool: Pool, seed: int, games: Predictor | None = None) -> Sampler:
    """Return the sampler of that name; `UserError` for a name nobody knows.

    `games` plays cases out, for samplers that make something of that.
    """
    if name not in SAMPLERS:
        raise UserError(
            f"there is no sampler {name!r}: {meant(name, SAMPLERS)}choose one of "
            f"{', '.join(SAMPLERS)}"
        )
    return SAMPLERS[name](pool, seed, games)
