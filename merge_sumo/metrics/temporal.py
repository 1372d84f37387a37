"""Requirements over time: signal temporal logic over the signals of an episode, by rtamt.

A formula has to hold, such as `always (v_vut_mps > 2)`. Its robustness at the beginning of the
episode (Donze and Maler, 2010) is above 0 where it holds, in the units of the signals. rtamt
(Nickovic and Yamaguchi, 2020) imports modules that a formula names: only known words and signs
reach it.
"""

from __future__ import annotations

import math
import re
from functools import lru_cache
from typing import Any

import numpy as np

from merge_sumo.errors import UserError
from merge_sumo.metrics.bodies import gaps_m, times_to_collision_s
from merge_sumo.metrics.expression import LEAST_MARGIN, MOST_CHARACTERS, MOST_MARGIN
from merge_sumo.printable import printable
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.scenario import DT_S, MAX_EPISODE_S, MAX_FOLLOW_UP_S, VUT
from merge_sumo.scenario.trajectory import Trajectory

SIGNALS = (
    "x_pov_m",
    "v_pov_mps",
    "a_pov_mps2",
    "x_vut_m",
    "v_vut_mps",
    "a_vut_mps2",
    "dx_m",
    "dv_mps",
    "bumper_gap_m",
    "ttc_s",
)
"""Signals of a formula, at every step; of the car that is nearest to the VUT at M."""
NEVER_S = 100.0
"""Time to collision where no gap closes, and the longest one."""
WORDS = (
    "always",
    "eventually",
    "until",
    "historically",
    "once",
    "since",
    "not",
    "and",
    "or",
    "implies",
    "iff",
    "xor",
    "rise",
    "fall",
    "prev",
    "next",
    "abs",
)
"""Operators of formulas."""
FINITE = ("Addition", "Subtraction", "Multiplication", "Abs", "Constant", "Predicate")
"""Parts of a formula with numbers, by rtamt's names: infinite ones would decide by chance."""
_TOKEN = re.compile(r"\s+|[A-Za-z_]\w*|(?:\d+\.?\d*|\.\d+)(?!\w)|<=|>=|->|[-+*<>()\[\]:,]")
_WORD = re.compile(r"[A-Za-z_]\w*")
_BOUNDS = re.compile(r"\[([^\]]*)\]")
_NUMBER = re.compile(r"\d+\.?\d*|\.\d+")


def check_formula(text: str) -> str:
    """Return a formula on one line, with single spaces; `try_formula` parses it.

    Args:
        text: the formula as the user wrote it.

    Raises:
        UserError: it has an unknown word or sign, or a time that no episode has.
    """
    if len(text) > MOST_CHARACTERS:
        raise UserError(f"`require` has {len(text)} characters: write at most {MOST_CHARACTERS}")
    what = f"`require` {printable(text[:80])!r}"
    if unknown := _TOKEN.sub("", text):
        sign = printable(unknown[0])
        raise UserError(f"{what}: {sign!r} is not part of a formula over signals")
    for word in _WORD.findall(text):
        if word not in (*SIGNALS, *WORDS):
            raise UserError(f"{what}: unknown signal {word!r}: choose {', '.join(SIGNALS)}")
    depth = 0
    for sign in text:
        depth += (sign == "(") - (sign == ")")
        if depth < 0:
            raise UserError(f"{what}: a closing bracket has no opening bracket")
    for bounds in _BOUNDS.findall(text):
        ends_s = [float(number) for number in _NUMBER.findall(bounds)]
        if ends_s != sorted(ends_s) or max(ends_s, default=0.0) > MAX_EPISODE_S + MAX_FOLLOW_UP_S:
            raise UserError(f"{what}: the times [{bounds}], in seconds, are not within an episode")
    return " ".join(text.split())


def try_formula(text: str) -> None:
    """Check that rtamt can evaluate a formula.

    Args:
        text: a checked formula.

    Raises:
        UserError: it cannot be parsed, or rtamt is missing.
    """
    try:
        _robustness(text, {name: np.ones(2) for name in SIGNALS})
    except ImportError as error:
        raise UserError(
            "`require` needs rtamt, which runs up to Python 3.12: pip install 'merge-sumo[stl]', "
            "or write a condition with `fail_when`"
        ) from error
    except UserError:
        raise
    # The parser of rtamt raises errors of many types.
    except Exception as error:
        raise UserError(
            f"`require` {text[:80]!r} is not a formula of signal temporal logic such as 'always "
            f"((x_vut_m > -20) implies (bumper_gap_m > 2))': {printable(str(error))[:200]}"
        ) from error


def signals(trajectory: Trajectory) -> dict[str, FloatArray]:
    """Return the signals of an episode by name, (T + 1,) each, with the follow-up after M.

    Args:
        trajectory: the motion.
    """
    pair = trajectory.whole[:, [trajectory.nearest, VUT]]
    gap_m, closing_mps = gaps_m(pair, trajectory.case.scenario.lengths_m)
    ttc_s = np.minimum(times_to_collision_s(np.maximum(gap_m, 0.0), closing_mps), NEVER_S)
    pov, vut = pair[:, 0], pair[:, 1]
    values = np.hstack([pov, vut, (pov - vut)[:, :2], gap_m, ttc_s])
    return dict(zip(SIGNALS, values.T, strict=True))


def robustness(text: str, trajectory: Trajectory) -> float:
    """Return the robustness of a formula at the beginning of an episode: finite, and never 0.

    Args:
        text: a checked formula.
        trajectory: the motion.
    """
    value = _robustness(text, signals(trajectory))
    size = min(max(abs(value), LEAST_MARGIN), MOST_MARGIN)
    return size if value > 0.0 else -size


def _robustness(text: str, values: dict[str, FloatArray]) -> float:
    steps = len(values["x_pov_m"])
    data = {"time": [round(step * DT_S, 1) for step in range(steps)]}
    for name, signal in values.items():
        data[name] = signal.tolist()
    specification = _specification(text)
    value = float(specification.evaluate(data)[0][1])
    # A minimum or a maximum over time hides infinite values: every part is checked, without the
    # infinities that an operator with bounds in time appends.
    for node, part in specification.ast.offline_results.items():
        if type(node).__name__ in FINITE and not all(map(math.isfinite, part[:steps])):
            raise UserError(
                f"`require` {printable(text[:80])!r} has infinite values: prev and next are "
                "infinite outside the episode. Put them around a comparison, not inside one, and "
                "write smaller numbers"
            )
    return value


@lru_cache(maxsize=8)
def _specification(text: str) -> Any:
    import rtamt

    specification = rtamt.StlDiscreteTimeOfflineSpecification()
    for name in SIGNALS:
        specification.declare_var(name, "float")
    specification.set_sampling_period(100, "ms", 0.1)
    specification.spec = f"({text})"  # text after a formula would not be read
    specification.parse()
    return specification
