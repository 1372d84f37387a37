"""Scenes for tests: a POV and a VUT in some corridors."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from merge_sumo.drivers.base import Scene


def scene_of(
    x_pov_m: ArrayLike = -250.0,
    v_pov_mps: ArrayLike = 30.0,
    x_vut_m: ArrayLike = -182.0,
    v_vut_mps: ArrayLike = 18.0,
    *,
    step: int = 0,
    active: ArrayLike = True,
) -> Scene:
    """Return a scene of K corridors; each argument is a number or (K,)."""
    columns = np.broadcast_arrays(x_pov_m, v_pov_mps, x_vut_m, v_vut_mps, active)
    x_pov, v_pov, x_vut, v_vut, runs = map(np.atleast_1d, columns)
    x_m, v_mps = np.array([x_pov, x_vut], dtype=float), np.array([v_pov, v_vut], dtype=float)
    return Scene(runs.astype(bool), np.full(len(runs), step), x_m, v_mps)
