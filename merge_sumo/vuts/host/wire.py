"""What the process that runs a campaign and the one that hosts a VUT say to each other.

A frame is its length, a running number, what it is about, and its content. Every question has one
answer with the same number.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import MERGE, NO_SIGNALS, NO_WISH, STAY, Scene
from merge_sumo.values.case import Case, FloatArray, ToldCase
from merge_sumo.values.scenario import RANGES, US23, Bounds, Scenario, lane_of
from merge_sumo.values.signals import Left, as_signals


class About(IntEnum):
    """What a frame is about; the first ones are questions, the others answers."""

    OPEN = 1
    MAKE = 2
    ACT = 3
    FILES = 4
    CLOSE = 5
    DONE = 10
    REFUSED = 11
    LOST = 12


HEAD: Final = struct.Struct("<IIB")
"""Bytes of content, number, about."""
MOST_BYTES: Final = 1 << 24
"""No frame is longer; a controller that writes into the channel could say anything."""


class WireError(Exception):
    """What came is no frame, or not the one that was expected."""


class Frame(NamedTuple):
    """A question or an answer."""

    number: int
    about: About
    content: bytes


def frame(number: int, about: About, content: bytes = b"") -> bytes:
    """Return the bytes of a frame."""
    return HEAD.pack(len(content), number, about) + content


def take(buffer: bytearray) -> Frame | None:
    """Take the first frame from a buffer; None while it is not whole. Raises `WireError`."""
    if len(buffer) < HEAD.size:
        return None
    length, number, about = HEAD.unpack_from(buffer)
    if length > MOST_BYTES or about not in About.__members__.values():
        raise WireError("it is no frame")
    if len(buffer) < HEAD.size + length:
        return None
    content = bytes(buffer[HEAD.size : HEAD.size + length])
    del buffer[: HEAD.size + length]
    return Frame(number, About(about), content)


def to_json(value: Any) -> bytes:
    """Return a value as JSON."""
    return json.dumps(value).encode()


def from_json(content: bytes, kind: type[Any]) -> Any:
    """Return the value of a type that JSON says; `WireError` where it says another."""
    try:
        value = json.loads(content)
    except (ValueError, RecursionError) as error:
        raise WireError("it is no JSON") from error
    if not isinstance(value, kind):
        raise WireError(f"it is no {kind.__name__}")
    return value


def numbers_from_json(content: bytes) -> dict[str, float]:
    """Return finite numbers by name that JSON says; `WireError` where it says something else."""
    numbers = from_json(content, dict)
    for value in numbers.values():
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            raise WireError("it is no number")
    return dict(numbers)


_TOLD: Final = ("x_vut0_m", "level0_a_mps2", "level0_v_mps", "a_min_mps2", "a_max_mps2")
"""What a VUT is told of its scenario, besides the acceleration lane."""
_NO_LANE: Final = (math.nan, math.nan)
_BEGIN: Final = struct.Struct(f"<II{len(_TOLD) + len(_NO_LANE)}d")
"""Corridor, draw, and what is told; position and speed of each vehicle follow."""
_HEAD: Final = struct.Struct("<IIIII")
"""Episodes that begin, corridors, vehicles, whether the cars that are met are told, and whether
VUTs have merged."""


def pack_scene(begun: Sequence[tuple[int, Case]], scene: Scene) -> bytes:
    """Return the episodes that begin with a scene, (corridor, case), and the scene, as bytes.

    Of a case only what its VUT may know travels.
    """
    vehicles, corridors = scene.x_m.shape
    optional = (scene.facing, scene.merged)
    tells = (array is not None for array in optional)
    parts = [_HEAD.pack(len(begun), corridors, vehicles, *tells)]
    for corridor, case in begun:
        told = (getattr(case.scenario, name) for name in _TOLD)
        parts.append(_BEGIN.pack(corridor, case.draw, *told, *(lane_of(case.scenario) or _NO_LANE)))
        parts.append(np.array(case.starts(), dtype=np.float64).tobytes())
    arrays = (scene.active, scene.step, scene.x_m, scene.v_mps, *optional)
    parts += [np.ascontiguousarray(array).tobytes() for array in arrays if array is not None]
    return b"".join(parts)


@lru_cache(maxsize=8)
def _any_scenario(lane_m: Bounds | None, *told: float) -> Scenario:
    """Return a scenario with what a VUT is told of its own; of the rest it is told nothing."""
    known: dict[str, Any] = dict(zip(_TOLD, told, strict=True))
    return replace(US23, **known, reach_m=RANGES["reach_m"][1], lane_m=lane_m)


def unpack_scene(content: bytes) -> tuple[list[tuple[int, Case]], Scene]:
    """Return what `pack_scene` packed; level and orientation of the cases are not in it."""
    count, k, vehicles, tells_met, tells_merged = _HEAD.unpack_from(content)
    at = _HEAD.size
    begun: list[tuple[int, Case]] = []
    for _ in range(count):
        corridor, draw, *told, begin_m, end_m = _BEGIN.unpack_from(content, at)
        at += _BEGIN.size
        starts = np.frombuffer(content, np.float64, 2 * vehicles, at).reshape(vehicles, 2)
        at += starts.nbytes
        rows = tuple((x_m, v_mps) for x_m, v_mps in starts.tolist())
        lane_m = None if math.isnan(begin_m) else (begin_m, end_m)
        scenario = _any_scenario(lane_m, *told)
        begun.append((corridor, ToldCase(level=0, draw=draw, scenario=scenario, told=rows)))
    active = np.frombuffer(content, np.bool_, k, at)
    step = np.frombuffer(content, np.int64, k, at + k)
    at += 9 * k
    x_m, v_mps = np.frombuffer(content, np.float64, 2 * vehicles * k, at).reshape(2, vehicles, k)
    at += x_m.nbytes + v_mps.nbytes
    met = np.frombuffer(content, np.int64, k, at) if tells_met else None
    at += 8 * k if tells_met else 0
    merged = np.frombuffer(content, np.bool_, k, at) if tells_merged else None
    return begun, Scene(active, step, x_m, v_mps, met, merged)


class Answers(NamedTuple):
    """Accelerations, (K,), and by corridor why one is not finite, and what was left with it.

    `wishes` is (K,), None where no answer has one.
    """

    a_mps2: FloatArray
    reasons: dict[int, str]
    signals: dict[int, Left]
    wishes: NDArray[np.int8] | None = None


def pack_answers(
    answers: FloatArray,
    reasons: Mapping[int, str],
    signals: Mapping[int, Left] = NO_SIGNALS,
    wishes: NDArray[np.int8] | None = None,
) -> bytes:
    """Return accelerations, (K,), the reasons of those that are not finite, signals and wishes."""
    more: dict[str, Any] = {"reasons": reasons, "signals": signals}
    if wishes is not None:
        more["wishes"] = wishes.tolist()
    return np.ascontiguousarray(answers, dtype=np.float64).tobytes() + (
        to_json(more) if any(more.values()) else b""
    )


def unpack_answers(content: bytes, k: int) -> Answers:
    """Return what `pack_answers` packed for `k` corridors.

    Raises `WireError`, KeyError, ValueError or AttributeError for what it did not.
    """
    if len(content) < 8 * k:
        raise WireError("it has too few answers")
    answers = np.frombuffer(content, np.float64, k)
    if len(content) == 8 * k:
        return Answers(answers, {}, {})
    said = from_json(content[8 * k :], dict)
    reasons = {int(corridor): str(reason) for corridor, reason in said["reasons"].items()}
    # Who wrote this runs a stranger's code: what it left is checked here, too.
    left = {int(corridor): as_signals(values) for corridor, values in said["signals"].items()}
    signals = {c: values for c, values in left.items() if 0 <= c < k}
    return Answers(answers, reasons, signals, _wishes(said.get("wishes"), k))


def _wishes(said: Any, k: int) -> NDArray[np.int8] | None:
    """Return the wishes that JSON says; `WireError` for what are none of `k` corridors."""
    if said is None:
        return None
    known = (NO_WISH, STAY, MERGE)
    if not isinstance(said, list) or len(said) != k:
        raise WireError("it has another number of wishes")
    if not all(type(wish) is int and wish in known for wish in said):
        raise WireError("a wish is none")
    return np.array(said, dtype=np.int8)
