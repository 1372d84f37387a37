"""What the process that runs a campaign and the one that hosts a VUT say to each other.

A frame is its length, a running number, what it is about, and its content. Every question has one
answer with the same number.
"""

from __future__ import annotations

import json
import os
import struct
import sys
from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum
from functools import lru_cache
from typing import Annotated, Any, Final, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np

from merge_sumo.drivers.base import Scene
from merge_sumo.scenario.case import Case, FloatArray, ToldCase
from merge_sumo.scenario.scenario import RANGES, US23, Bounds, Scenario, lane_of
from merge_sumo.scenario.signals import as_signals
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


def write(descriptor: int, content: bytes) -> None:
    """Write all of it; raises OSError where that cannot be."""
    rest = memoryview(content)
    while rest:
        rest = rest[os.write(descriptor, rest) :]


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
    data: list[str]


class Lost(msgspec.Struct, frozen=True):
    """Fields of a `VutLostError`."""

    reason: str
    corridor: int | None
    final: bool


class Said(msgspec.Struct, frozen=True, omit_defaults=True):
    """What comes with accelerations: why one is not finite and what was left, by corridor.

    `wishes` are those of all corridors; None where no answer has one.
    """

    reasons: dict[int, str] = {}
    signals: dict[int, dict[str, Any]] = {}
    wishes: list[Literal[-1, 0, 1]] | None = None


NOTHING: Final = Said()


_TOLD: Final = ("x_vut0_m", "level0_a_mps2", "level0_v_mps", "a_min_mps2", "a_max_mps2")
"""What a VUT is told of its scenario, besides the acceleration lane."""
_DTYPES: Final = (np.bool_, np.int64, np.float64, np.float64, np.int64, np.bool_)
"""Of the arrays of a `Scene`."""


class _Begun(msgspec.Struct, array_like=True, frozen=True):
    """An episode that begins in a corridor."""

    corridor: int
    draw: int
    told: tuple[float, ...]
    lane_m: tuple[float, float] | None
    starts: tuple[tuple[float, float], ...]


def pack_scene(begun: Sequence[tuple[int, Case]], scene: Scene) -> bytes:
    """Return the episodes that begin with a scene, (corridor, case), and the scene, as bytes.

    Of a case only what its VUT may know travels.
    """
    episodes = []
    for corridor, case in begun:
        told = tuple(float(getattr(case.scenario, name)) for name in _TOLD)
        starts = tuple((float(x_m), float(v_mps)) for x_m, v_mps in case.starts())
        episodes.append(_Begun(corridor, case.draw, told, lane_of(case.scenario), starts))
    arrays = [
        None if array is None else np.ascontiguousarray(array, dtype).tobytes()
        for array, dtype in zip(scene, _DTYPES, strict=True)
    ]
    return msgspec.msgpack.encode((episodes, arrays))


_SCENE: Final = msgspec.msgpack.Decoder(tuple[list[_Begun], list[bytes | None]])


@lru_cache(maxsize=8)
def _any_scenario(lane_m: Bounds | None, *told: float) -> Scenario:
    """Return a scenario with what a VUT is told of its own; of the rest it is told nothing."""
    known: dict[str, Any] = dict(zip(_TOLD, told, strict=True))
    return replace(US23, **known, reach_m=RANGES["reach_m"][1], lane_m=lane_m)


def unpack_scene(content: bytes) -> tuple[list[tuple[int, Case]], Scene]:
    """Return what `pack_scene` packed; level and orientation of the cases are not in it."""
    episodes, packed = _SCENE.decode(content)
    begun: list[tuple[int, Case]] = []
    for one in episodes:
        scenario = _any_scenario(one.lane_m, *one.told)
        case = ToldCase(level=0, draw=one.draw, scenario=scenario, told=one.starts)
        begun.append((one.corridor, case))
    arrays: list[Any] = [
        None if array is None else np.frombuffer(array, dtype)
        for array, dtype in zip(packed, _DTYPES, strict=True)
    ]
    active, step, x_m, v_mps, facing, merged = arrays
    shape = -1, len(active)
    return begun, Scene(active, step, x_m.reshape(shape), v_mps.reshape(shape), facing, merged)


def pack_answers(answers: FloatArray, said: Said = NOTHING) -> bytes:
    """Return accelerations, (K,), and what comes with them, as bytes."""
    numbers = np.ascontiguousarray(answers, dtype=np.float64).tobytes()
    return numbers if said == NOTHING else numbers + to_json(said)


def unpack_answers(content: bytes, k: int) -> tuple[FloatArray, Said]:
    """Return what `pack_answers` packed for `k` corridors; `WireError` for what it did not."""
    if len(content) < 8 * k:
        raise WireError("it has too few answers")
    answers = np.frombuffer(content, np.float64, k)
    if len(content) == 8 * k:
        return answers, NOTHING
    said = from_json(content[8 * k :], Said)
    if said.wishes is not None and len(said.wishes) != k:
        raise WireError("it has another number of wishes")
    # Who wrote this runs a stranger's code: what it left is checked here, too.
    signals = {c: as_signals(values) for c, values in said.signals.items() if 0 <= c < k}
    return answers, Said(said.reasons, dict(signals), said.wishes)
