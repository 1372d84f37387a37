"""What a driver sees, and what it has to do."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from merge_sumo.values.case import Case, FloatArray


@dataclass(frozen=True, slots=True)
class Scene:
    """The state of K corridors at one step, as read from SUMO; every array has shape (K,).

    Attributes:
        active: whether an episode runs in the corridor; elsewhere the numbers mean nothing.
        step: steps since the episode of the corridor began.
        x_pov_m: distance of the POV's front bumper to M along its lane, negative before M.
        v_pov_mps: speed of the POV.
        x_vut_m: distance of the VUT's front bumper to M along its lane, negative before M.
        v_vut_mps: speed of the VUT.
    """

    active: NDArray[np.bool_]
    step: NDArray[np.int64]
    x_pov_m: FloatArray
    v_pov_mps: FloatArray
    x_vut_m: FloatArray
    v_vut_mps: FloatArray


class VutLostError(Exception):
    """What a driver knew of its corridors is gone: their episodes have to begin anew.

    Attributes:
        reason: what happened.
        corridor: whose doing it was; None where nobody knows.
        final: whether the case whose doing it was would do it again; a process that died may have
            died of what came before.
    """

    def __init__(self, reason: str, corridor: int | None = None, *, final: bool = False) -> None:
        """Take what happened, and what is known of it."""
        super().__init__(reason)
        self.reason, self.corridor, self.final = reason, corridor, final


class Driver(ABC):
    """Drives the same vehicle in K corridors at once; the corridors are independent."""

    def __init__(self, corridors: int) -> None:
        """Prepare for corridors 0 to `corridors` - 1."""
        self.corridors = corridors

    def begin(self, corridor: int, case: Case) -> None:  # noqa: B027 (most drivers remember nothing)
        """Forget everything about a corridor: a new episode begins there."""

    @abstractmethod
    def act(self, scene: Scene) -> FloatArray:
        """Return the acceleration in each corridor, (K,), m/s2, until the next step.

        A value that is not finite ends the episode of its corridor as VUT_ERROR. Raises
        `VutLostError` where the episodes of all corridors have to begin anew.
        """

    def reason(self, corridor: int) -> str | None:
        """Return why the last answer for a corridor was not finite, if the driver knows."""
        return None

    def files(self) -> tuple[Path, ...]:
        """Return the files of the user's that have decided on its answers so far."""
        return ()

    def close(self) -> None:  # noqa: B027 (most drivers hold nothing)
        """Release what the driver holds: processes, sockets."""
