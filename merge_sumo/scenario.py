"""The numbers of the merging scenario: Wang et al., sections VI and VII and Table I.

Each lane has its own coordinate: the distance of the front bumper along the lane from the merge
point M, in metres, negative before M.
"""

from __future__ import annotations

from typing import Final

DT_S: Final = 0.1
"""Step of the equations of motion, eq. (4)."""
MAX_STEPS: Final = 300
"""An episode that has not ended after this many steps (30 s) is a TIMEOUT."""

A_MIN_MPS2: Final = -4.0
A_MAX_MPS2: Final = 2.0

X_VUT0_M: Final = -182.0
V_VUT0_MPS: Final = 18.0
"""The default: the initial speed of the VUT is observed, not chosen by the tester."""
V_VUT0_MAX_MPS: Final = 45.0

LEVELS: Final = (0, 1, 2)
"""Levels of reasoning of the POV."""

V_HW_MAX_MPS: Final = 35.0
V_HW_MIN_MPS: Final = 24.6
V_MIN_MPS: Final = 12.0
TTC_MIN_S: Final = 7.0
DX_CRASH_M: Final = 6.0
DX_CRITICAL_M: Final = 15.0

LEVEL0_A_MPS2: Final = 1.0
LEVEL0_V_MPS: Final = 28.0
"""A level-0 VUT accelerates by `LEVEL0_A_MPS2` to this speed and holds it, section VI-B."""

DEADLINE_S: Final = 5.0
"""A VUT that takes longer than this for one step, or for one reset, is a VUT_ERROR."""

MEMORY_GIB: Final = 4.0
"""A user's code that takes more memory than this fails to get it."""
