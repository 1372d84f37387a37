"""What the process that runs a campaign and the one that hosts a VUT say to each other.

A frame is its length, a running number, what it is about, and its content. Every question has one
answer with the same number.
"""

from __future__ import annotations

import json
import math
import struct
import sys
from collections.abc import Mapping, Sequence
from dataclasses import replace
from enum import IntEnum
from functools import lru_cache
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np
from numpy.typing import NDArray

from merge_sumo.drivers.base import NO_SIGNALS, Scene
from merge_sumo.values.case import Case, FloatArray, ToldCase
from merge_sumo.values.scenario import RANGES, US23, Bounds, Scenario, lane_of
from merge_sumo.values.signals import Left, as_signals
from merge_sumo.vuts.base import VutSpec

T = TypeVar("T")


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
    """Return a value as JSON; texts may have surrogates, as names of files do."""
    return json.dumps(msgspec.to_builtins(value, str_keys=True)).encode()


def from_json(content: bytes, kind: type[T]) -> T:
    """Return the value of a type that JSON says; `WireError` where it says another."""
    try:
        return msgspec.convert(json.loads(content), kind, str_keys=True)
    except (msgspec.ValidationError, ValueError, RecursionError) as error:
        raise WireError("it is not what was asked for") from error


Number = Annotated[float, msgspec.Meta(ge=-sys.float_info.max, le=sys.float_info.max)]
"""A finite one."""


class Opening(msgspec.Struct, frozen=True):
    """The VUT that is to be opened."""

    spec: VutSpec
    deadline_s: float


class Facts(msgspec.Struct, frozen=True):
    """Facts of a VUT that was opened, as those of `Vut`."""

    max_corridors: int | None
    max_workers: int | None
    files: list[str]


class Lost(msgspec.Struct, frozen=True):
    """Fields of a `VutLostError`."""

    reason: str
    corridor: int | None
    final: bool


class _Beside(msgspec.Struct, frozen=True, omit_defaults=True):
    """What an answer says besides accelerations, by corridor."""

    reasons: dict[int, str] = {}
    signals: dict[int, dict[str, Any]] = {}
    wishes: list[Literal[-1, 0, 1]] | None = None


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
    numbers = np.ascontiguousarray(answers, dtype=np.float64).tobytes()
    if not reasons and not signals and wishes is None:
        return numbers
    said = None if wishes is None else wishes.tolist()
    return numbers + to_json(_Beside(dict(reasons), dict(signals), said))


def unpack_answers(content: bytes, k: int) -> Answers:
    """Return what `pack_answers` packed for `k` corridors.

    Raises `WireError` for what it did not.
    """
    if len(content) < 8 * k:
        raise WireError("it has too few answers")
    answers = np.frombuffer(content, np.float64, k)
    if len(content) == 8 * k:
        return Answers(answers, {}, {})
    said = from_json(content[8 * k :], _Beside)
    if said.wishes is not None and len(said.wishes) != k:
        raise WireError("it has another number of wishes")
    # Who wrote this runs a stranger's code: what it left is checked here, too.
    signals = {c: as_signals(values) for c, values in said.signals.items() if 0 <= c < k}
    wishes = None if said.wishes is None else np.array(said.wishes, dtype=np.int8)
    return Answers(answers, said.reasons, signals, wishes)
