"""Messages between a process that runs cases and the process that hosts their controller.

Each request has one answer. While a request takes long, an answer of None says that it proceeds.
Nothing is pickled: the hosting process runs a user's code, so what it sends is data of known types.
"""

from __future__ import annotations

from typing import Any, Final, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from merge_sumo.controllers.controller import ControllerDriver, Start
from merge_sumo.controllers.spec import ControllerSpec
from merge_sumo.drivers.base import MERGE, NO_WISH, STAY, Scene
from merge_sumo.scenario.case import FloatArray
from merge_sumo.scenario.signals import Left


class HostRequest(msgspec.Struct, omit_defaults=True):
    """Load a controller, make its drivers, let them act, list its files, or close them.

    Attributes:
        action: what to do.
        kind: "MODULE:CLASS" of the kind of the controller to load.
        spec: the controller to load.
        deadline_s: time for one call of it.
        corridors: number of corridors to make drivers for.
        starts: episodes that begin before the drivers act, by corridor.
        scene: arrays of the scene in which they act.
    """

    action: Literal["load", "make", "act", "files", "close"]
    kind: str = ""
    spec: ControllerSpec | None = None
    deadline_s: float = 0.0
    corridors: int = 0
    starts: list[tuple[int, Start]] = []
    scene: tuple[bytes | None, ...] = ()


class HostReply(msgspec.Struct, omit_defaults=True):
    """The answer to a request.

    Attributes:
        failed: why the request failed; "" where it did not.
        max_corridors: corridors that one driver can serve.
        max_workers: processes that can have a driver.
        files: files of code that were loaded so far.
        parameters: those of the controllers that were made.
        accelerations_mps2: answers of the drivers.
        wishes: whether they wish to merge.
        reasons: what is wrong with an answer, by corridor.
        signals: signals of the answers, by corridor.
    """

    failed: str = ""
    max_corridors: int | None = None
    max_workers: int | None = None
    files: list[bytes] = []
    parameters: dict[str, float] = {}
    accelerations_mps2: bytes = b""
    wishes: bytes | None = None
    reasons: dict[int, str] = {}
    signals: dict[int, Left] = {}

    @classmethod
    def of(cls, driver: ControllerDriver, scene: Scene) -> HostReply:
        """Return what a driver answers to a scene."""
        answers, reasons = driver.act(scene), dict[int, str]()
        for corridor in np.flatnonzero(~np.isfinite(answers) & scene.active).tolist():
            if (reason := driver.reason(corridor)) is not None:
                reasons[corridor] = reason
        wishes = driver.wishes()
        return cls(
            accelerations_mps2=answers.tobytes(),
            wishes=None if wishes is None else wishes.astype(np.int8).tobytes(),
            reasons=reasons,
            signals=dict(driver.signals()),
        )

    def numbers(self, corridors: int) -> tuple[FloatArray, NDArray[np.int8] | None]:
        """Return accelerations and wishes, (K,); ValueError for what no driver answers."""
        answers = np.frombuffer(self.accelerations_mps2, np.float64)
        wishes = None if self.wishes is None else np.frombuffer(self.wishes, np.int8)
        if len(answers) != corridors or (wishes is not None and len(wishes) != corridors):
            raise ValueError("an answer has the numbers of other corridors")
        if wishes is not None and not np.isin(wishes, (NO_WISH, STAY, MERGE)).all():
            raise ValueError("an answer has a number that is not a wish")
        return answers, wishes


_DTYPES: Final = (np.bool_, np.int64, np.float64, np.float64, np.int64, np.bool_)
"""Of the arrays of a `Scene`."""


def packed(scene: Scene) -> tuple[bytes | None, ...]:
    """Return the arrays of a scene as bytes."""
    contents: list[bytes | None] = []
    for array, dtype in zip(scene, _DTYPES, strict=True):
        contents.append(None if array is None else np.ascontiguousarray(array, dtype).tobytes())
    return tuple(contents)


def unpacked(contents: tuple[bytes | None, ...]) -> Scene:
    """Return the scene of arrays as bytes."""
    arrays: list[Any] = []
    for content, dtype in zip(contents, _DTYPES, strict=True):
        arrays.append(None if content is None else np.frombuffer(content, dtype))
    active, step, x_m, v_mps, facing, merged = arrays
    shape = -1, len(active)
    return Scene(active, step, x_m.reshape(shape), v_mps.reshape(shape), facing, merged)


encode: Final = msgspec.msgpack.Encoder().encode
decode_request: Final = msgspec.msgpack.Decoder(HostRequest).decode
decode_answer: Final = msgspec.msgpack.Decoder(HostReply | None).decode
