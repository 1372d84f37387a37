"""Level-set estimation: the straddle criterion on a Gaussian process of `botorch`."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from merge_sumo.samplers.base import LevelwiseSampler
from merge_sumo.samplers.history import LevelHistory
from merge_sumo.scenario.case import FloatArray

if TYPE_CHECKING:
    from botorch.acquisition import AcquisitionFunction

DESIGN: Final = 10
"""Cases of a level before the first process is fitted: 5 for each coordinate of most problems."""
CANDIDATES: Final = 1024
"""Sobol points among which a batch is chosen."""
KAPPA: Final = 1.96
"""Weight of the standard deviation, as in the paper."""


class StraddleSampler(LevelwiseSampler):
    """Chooses where a Gaussian process on the margin is uncertain, and near the limit of failing.

    Source: Bryan et al., "Active Learning for Identifying Function Threshold Boundaries" (2005):
    kappa sigma - |mu - limit|, which is the ambiguity of GP-UCB level sets (Gotovos et al., 2013)
    with kappa^2 for beta. A batch is chosen one point at a time by `optimize_acqf_discrete`; at its
    pending points the process takes its own mean. Kernel and priors come from
    `get_matern_kernel_with_gamma_prior`: the default of `SingleTaskGP`, a squared exponential with
    long length scales, found fewer failures of the VUTs on which this was chosen.
    """

    about = "estimates the level set of the margin by the straddle criterion (botorch)"
    colour = "#CC79A7"

    def batch_size(self) -> int:
        """Return few cases first, 5 a level, then 10 and 20: a fit takes longer with each case."""
        per_level = self.proposed() / len(self.pool.levels)
        return (5 if per_level < 50 else 10 if per_level < 200 else 20) * len(self.pool.levels)

    def propose(
        self, history: LevelHistory, n: int, rng: np.random.Generator, level: int
    ) -> FloatArray:
        """Return the `n` candidates of the highest straddle, (n, d)."""
        import torch
        from botorch.optim import optimize_acqf_discrete
        from botorch.utils.sampling import draw_sobol_samples
        from threadpoolctl import threadpool_limits

        cube = torch.tensor([[0.0], [1.0]], dtype=torch.float64).repeat(1, history.dims)
        designing = len(history.points) < DESIGN
        seed = int(rng.integers(2**31))
        points = draw_sobol_samples(cube, n if designing else CANDIDATES, 1, seed=seed).squeeze(1)
        if designing:
            return np.asarray(points.numpy(), dtype=np.float64)
        # One thread: rounding must not depend on the number of cores.
        with threadpool_limits(1), torch.no_grad():
            best, _ = optimize_acqf_discrete(_straddle(history), n, points)
        return np.asarray(best.numpy(), dtype=np.float64)


def _fitted(points: FloatArray, values: FloatArray) -> Any:
    """Return the `SingleTaskGP` of maximum a posteriori on values with mean 0 and variance 1."""
    import torch
    from botorch.fit import fit_gpytorch_mll
    from botorch.models import SingleTaskGP
    from botorch.models.utils.gpytorch_modules import get_matern_kernel_with_gamma_prior
    from gpytorch.mlls import ExactMarginalLogLikelihood

    process = SingleTaskGP(
        torch.from_numpy(points),
        torch.from_numpy(values)[:, None],
        covar_module=get_matern_kernel_with_gamma_prior(points.shape[1]),
        outcome_transform=None,
    )
    with torch.enable_grad(), warnings.catch_warnings():
        # A fit that stops early is good enough for a batch.
        warnings.simplefilter("ignore")
        fit_gpytorch_mll(ExactMarginalLogLikelihood(process.likelihood, process))
    return process


def _straddle(history: LevelHistory) -> AcquisitionFunction:
    """Return the acquisition function after a history."""
    from botorch.acquisition import AcquisitionFunction
    from torch import Tensor

    mean, deviation = history.margin.mean(), max(float(history.margin.std()), 1e-6)
    limit = float(-mean / deviation)
    told = _fitted(history.points, (history.margin - mean) / deviation)

    # The classes of botorch have no types for the checker.
    class Straddle(AcquisitionFunction):
        """kappa sigma - |mu - limit|, for one point at a time."""

        def __init__(self) -> None:
            super().__init__(told)
            self.X_pending: Tensor | None = None

        def set_X_pending(self, X_pending: Tensor | None = None) -> None:  # noqa: N802, N803
            """Let the process believe its mean at points, (m, d)."""
            self.X_pending = X_pending
            self.model = told
            if X_pending is not None:
                believed = told.posterior(X_pending).mean
                self.model = told.condition_on_observations(X_pending, believed)

        def forward(self, X: Tensor) -> Tensor:  # noqa: N803
            """Return the straddle at points, (m, 1, d), as (m,)."""
            posterior = self.model.posterior(X)
            straddle: Tensor = KAPPA * posterior.variance.sqrt() - (posterior.mean - limit).abs()
            return straddle[:, 0, 0]

    return Straddle()
