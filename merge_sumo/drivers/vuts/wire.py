"""What the process that runs a campaign and the one that hosts a VUT say to each other.

A frame is its length, a running number, what it is about, and its content. Every question has one
answer with the same number.
"""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from dataclasses import replace
from enum import IntEnum
from functools import lru_cache
from typing import Any, Final, NamedTuple

import numpy as np

from merge_sumo.drivers.base import Scene
from merge_sumo.values.case import Case, FloatArray
from merge_sumo.values.scenario import US23, Scenario


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


_BEGIN: Final = struct.Struct("<I4d")


def pack_scene(begun: Sequence[tuple[int, Case]], scene: Scene) -> bytes:
    """Return the episodes that begin with a scene, (corridor, case), and the scene, as bytes.

    Of a case only what its VUT may know travels.
    """
    parts = [struct.pack("<II", len(begun), len(scene.active))]
    parts += [
        _BEGIN.pack(
            corridor,
            case.x_pov0_m,
            case.v_pov0_mps,
            case.v_vut0_mps,
            case.scenario.x_vut0_m,
        )
        for corridor, case in begun
    ]
    parts += [scene.active.tobytes(), scene.step.tobytes()]
    columns = (scene.x_pov_m, scene.v_pov_mps, scene.x_vut_m, scene.v_vut_mps)
    parts += [np.ascontiguousarray(column).tobytes() for column in columns]
    return b"".join(parts)


ANYTHING: Final = 1e9
"""A bound that no start reaches: cases were checked where they were made."""


@lru_cache(maxsize=8)
def _any_scenario(x_vut0_m: float) -> Scenario:
    """Return a scenario in which the VUT starts there; the rest of it a VUT is not told."""
    return replace(US23, x_vut0_m=x_vut0_m, reach_m=ANYTHING, v_start_max_mps=ANYTHING)


def unpack_scene(content: bytes) -> tuple[list[tuple[int, Case]], Scene]:
    """Return what `pack_scene` packed; level and orientation of the cases are not in it."""
    count, k = struct.unpack_from("<II", content)
    at = 8
    begun = []
    for _ in range(count):
        corridor, x_pov0_m, v_pov0_mps, v_vut0_mps, x_vut0_m = _BEGIN.unpack_from(content, at)
        case = Case(
            level=0,
            x_pov0_m=x_pov0_m,
            v_pov0_mps=v_pov0_mps,
            v_vut0_mps=v_vut0_mps,
            scenario=_any_scenario(x_vut0_m),
        )
        begun.append((corridor, case))
        at += _BEGIN.size
    active = np.frombuffer(content, np.bool_, k, at)
    step = np.frombuffer(content, np.int64, k, at + k)
    state = np.frombuffer(content, np.float64, 4 * k, at + 9 * k).reshape(4, k)
    return begun, Scene(active, step, *state)


def pack_answers(answers: FloatArray, reasons: dict[int, str]) -> bytes:
    """Return accelerations, (K,), and the reasons of those that are not finite, as bytes."""
    return np.ascontiguousarray(answers, dtype=np.float64).tobytes() + (
        to_json(reasons) if reasons else b""
    )


def unpack_answers(content: bytes, k: int) -> tuple[FloatArray, dict[int, str]]:
    """Return what `pack_answers` packed for `k` corridors; raises `WireError`."""
    if len(content) < 8 * k:
        raise WireError("it has too few answers")
    answers = np.frombuffer(content, np.float64, k)
    said = from_json(content[8 * k :], dict) if len(content) > 8 * k else {}
    return answers, {int(corridor): str(reason) for corridor, reason in said.items()}
