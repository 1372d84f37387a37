"""Messages between a process that runs cases and the process that hosts their controller.

Each request has one answer. While a request takes long, `Alive` says that it proceeds. Nothing is
pickled: the hosting process runs a user's code, so what it sends is data of known types.
"""

from __future__ import annotations

from typing import Any, Final

import msgspec
import numpy as np
from numpy.typing import NDArray

from merge_sumo.controllers.controller import ControllerDriver, Start
from merge_sumo.drivers.base import MERGE, NO_WISH, STAY, Scene
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.signals import Left, as_signals

MOST_BYTES: Final = 1 << 24
"""Maximum size of a message."""


class Message(msgspec.Struct, tag=True, array_like=True):
    """A request or an answer."""


class Make(Message):
    """Make the drivers of a number of corridors; the answer is `Made`."""

    corridors: int


class Act(Message):
    """Begin episodes, by corridor, then act in a scene; the answer is `Acted`."""

    starts: list[tuple[int, Start]]
    scene: tuple[bytes | None, ...]


class ListFiles(Message):
    """List the code that was loaded; the answer is `Loaded`."""


class Close(Message):
    """Close the controllers; the answer is `Loaded`, and the process ends."""


class Ready(Message):
    """The controller is loaded, with what its kind knows of it; sent without a request."""

    max_corridors: int | None
    max_workers: int | None
    files: list[bytes]


class Made(Message):
    """The controllers are made, with their parameters."""

    parameters: dict[str, float]


class Loaded(Message):
    """Files of code that were loaded."""

    files: list[bytes]


class Failed(Message):
    """The request failed, for a reason."""

    reason: str


class Alive(Message):
    """The request proceeds from one controller to the next."""


class Acted(Message):
    """The answers of the controllers, with reasons and signals by corridor."""

    accelerations_mps2: bytes
    reasons: dict[int, str]
    signals: dict[int, Left]
    wishes: bytes | None

    @classmethod
    def of(cls, driver: ControllerDriver, scene: Scene) -> Acted:
        """Return what a driver answers to a scene."""
        answers, reasons = driver.act(scene), dict[int, str]()
        for corridor in np.flatnonzero(~np.isfinite(answers) & scene.active).tolist():
            if (reason := driver.reason(corridor)) is not None:
                reasons[corridor] = reason
        wishes = driver.wishes()
        packed = None if wishes is None else wishes.astype(np.int8).tobytes()
        return cls(answers.tobytes(), reasons, dict(driver.signals()), packed)

    def numbers(self, corridors: int) -> tuple[FloatArray, NDArray[np.int8] | None]:
        """Return accelerations and wishes, (K,); ValueError for what no driver answers."""
        answers = np.frombuffer(self.accelerations_mps2, np.float64)
        wishes = None if self.wishes is None else np.frombuffer(self.wishes, np.int8)
        if len(answers) != corridors or (wishes is not None and len(wishes) != corridors):
            raise ValueError("an answer has the numbers of other corridors")
        if wishes is not None and not np.isin(wishes, (NO_WISH, STAY, MERGE)).all():
            raise ValueError("an answer has a number that is not a wish")
        return answers, wishes

    def checked_signals(self) -> dict[int, Left]:
        """Return the signals, bounded as those of any controller."""
        return {corridor: as_signals(left) for corridor, left in self.signals.items()}


_DTYPES: Final = (np.bool_, np.int64, np.float64, np.float64, np.int64, np.bool_)
"""Of the arrays of a `Scene`."""


def packed(scene: Scene) -> tuple[bytes | None, ...]:
    """Return the arrays of a scene as bytes."""
    pairs = zip(scene, _DTYPES, strict=True)
    return tuple(None if a is None else np.ascontiguousarray(a, t).tobytes() for a, t in pairs)


def unpacked(arrays: tuple[bytes | None, ...]) -> Scene:
    """Return the scene of arrays as bytes."""
    found: list[Any] = []
    for content, dtype in zip(arrays, _DTYPES, strict=True):
        found.append(None if content is None else np.frombuffer(content, dtype))
    active, step, x_m, v_mps, facing, merged = found
    shape = -1, len(active)
    return Scene(active, step, x_m.reshape(shape), v_mps.reshape(shape), facing, merged)


encode: Final = msgspec.msgpack.Encoder().encode
decode_request: Final = msgspec.msgpack.Decoder(Make | Act | ListFiles | Close).decode
decode_answer: Final = msgspec.msgpack.Decoder(
    Ready | Made | Acted | Loaded | Failed | Alive
).decode
