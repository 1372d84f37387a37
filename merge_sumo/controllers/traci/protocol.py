"""The bytes of TraCI, the protocol by which a program controls SUMO.

https://sumo.dlr.de/docs/TraCI/Protocol.html: a message is a length and commands; a command is a
length, an identifier and a payload; numbers are big-endian.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import partial
from operator import attrgetter, itemgetter
from typing import Any, NamedTuple

from merge_sumo.sumo.traci_names import pack

MAX_MESSAGE_BYTES = 1 << 20
"""Limit of a message; random bytes that are read as a length mostly exceed it."""
MAX_NESTING = 4
"""Limit of compounds in compounds."""
API_VERSION = 22
"""Version of the TraCI of SUMO 1.28."""
VERSION, STEP, SET_ORDER, CLOSE = 0x00, 0x02, 0x03, 0x7F
GET_VEHICLE, GET_JUNCTION, SET_VEHICLE = 0xA4, 0xA9, 0xC4
OK, ERROR = 0x00, 0xFF
VALUES = {0x07: "B", 0x08: "b", 0x09: "i", 0x0B: "d", 0x0C: "s"}
LISTS = {0x0E: "s", 0x10: "d"}
"""Forms of `Reader.value` by types of values, and by types of lists for their items."""
COMPOUND, COLOR = 0x0F, 0x11
LON_LAT, ROAD = 0x00, 0x04
POSITIONS = "dd", "dd", "ddd", "ddd", "sdB"
PLACES = "goGOr"
"""Forms of `Reader.value`, and letters of `pack`, by the types of positions.

They are: on earth, in the plane, both with height, and on a road.
"""


class ProtocolError(Exception):
    """Bytes that are not TraCI; the text gives the reason."""


class Command(NamedTuple):
    """A command of a message.

    Attributes:
        identifier: its number.
        payload: the bytes after it.
    """

    identifier: int
    payload: bytes


class Position(NamedTuple):
    """A position.

    Attributes:
        kind: its type, an index of `POSITIONS`.
        place: coordinates, or road, position along it in m and number of the lane.
    """

    kind: int
    place: list[Any]


class Reader:
    """Reads values from bytes, one after the other; its methods raise `ProtocolError`."""

    def __init__(self, data: bytes) -> None:
        """Begin at the first byte.

        Args:
            data: the bytes.
        """
        self._data, self._at = data, 0

    @property
    def left(self) -> int:
        """Number of bytes that have not been read."""
        return len(self._data) - self._at

    def raw(self, count: int) -> bytes:
        """Return the next bytes.

        Args:
            count: their number.
        """
        if not 0 <= count <= self.left:
            raise ProtocolError(f"{count} bytes were announced, but {self.left} are left")
        start, self._at = self._at, self._at + count
        return self._data[start : self._at]

    def value(self, form: str) -> Any:
        """Return the next value.

        Args:
            form: a form of `struct` for a number, or "s" for a string.
        """
        if form != "s":
            (number,) = struct.unpack(f"!{form}", self.raw(struct.calcsize(f"!{form}")))
            return number
        try:
            return self.raw(self.value("i")).decode("utf-8")
        except UnicodeDecodeError as error:
            raise ProtocolError("a string is not UTF-8") from error

    def typed(self, nesting: int = 0) -> Any:
        """Return the next value, with a type before it; a compound is a list of its values.

        Args:
            nesting: number of compounds that it is in.
        """
        kind = self.value("B")
        if kind in VALUES:
            return self.value(VALUES[kind])
        if kind in LISTS:
            return tuple(self._items(partial(self.value, LISTS[kind])))
        if kind == COLOR:
            return tuple(self.raw(4))
        if kind < len(POSITIONS):
            return Position(kind, list(map(self.value, POSITIONS[kind])))
        if kind == COMPOUND and nesting < MAX_NESTING:
            return self._items(partial(self.typed, nesting + 1))
        raise ProtocolError(f"a value of type 0x{kind:02x} is not expected here")

    def typed_bytes(self) -> bytes:
        """Return the bytes of the next value with its type."""
        start = self._at
        self.typed()
        return self._data[start : self._at]

    def arguments(self) -> list[Any]:
        """Return the values that are left, in order; those of compounds one by one."""
        values: list[Any] = []
        while self.left:
            values += _flat(self.typed())
        return values

    def _items(self, read: Callable[[], Any]) -> list[Any]:
        return [read() for _ in range(self._length())]

    def _length(self) -> int:
        length: int = self.value("i")
        if not 0 <= length <= self.left:
            raise ProtocolError(f"{length} items were announced, but {self.left} bytes are left")
        return length


def _flat(value: Any) -> list[Any]:
    """Return the values of a compound and of the compounds in it."""
    if not isinstance(value, list):
        return [value]
    values = []
    for part in value:
        values += _flat(part)
    return values


def message_length(head: bytes) -> int:
    """Return the number of bytes that follow the length of a message.

    Args:
        head: its first four bytes.

    Raises:
        ProtocolError: if it is negative, or above the limit.
    """
    length = int.from_bytes(head, "big", signed=True) - 4
    if not 0 <= length <= MAX_MESSAGE_BYTES:
        raise ProtocolError(f"a message of {length + 4} bytes was announced")
    return length


def commands_of(body: bytes) -> list[Command]:
    """Return the commands of a message.

    Args:
        body: the message without its first four bytes.

    Raises:
        ProtocolError: if these are not commands.
    """
    reader = Reader(body)
    commands: list[Command] = []
    while reader.left or not commands:
        length, head = reader.value("B"), 1
        if length == 0:
            length, head = reader.value("i"), 5
        if length <= head:
            raise ProtocolError(f"a command of {length} bytes was announced")
        identifier, *_ = content = reader.raw(length - head)
        commands.append(Command(identifier, content[1:]))
    return commands


def message(content: bytes) -> bytes:
    """Return a message.

    Args:
        content: its commands.
    """
    return struct.pack("!i", len(content) + 4) + content


def command(content: bytes) -> bytes:
    """Return a command.

    Args:
        content: its identifier and its payload.
    """
    if len(content) < 255:
        return bytes((len(content) + 1,)) + content
    return b"\x00" + struct.pack("!i", len(content) + 5) + content


def status(identifier: int, result: int = OK, text: str = "") -> bytes:
    """Return the first answer to every command.

    Args:
        identifier: number of the command.
        result: `OK` or `ERROR`.
        text: message of an error.
    """
    # Clients read the length as one byte.
    short = text.encode()[:200].decode(errors="ignore")
    return command(bytes((identifier, result)) + string(short))


def string(value: str) -> bytes:
    """Return a string without its type.

    Args:
        value: the string.
    """
    encoded = value.encode()
    return struct.pack("!i", len(encoded)) + encoded


def compound(count: int, content: bytes) -> bytes:
    """Return a compound.

    Args:
        count: number of its values.
        content: the values with their types.
    """
    return struct.pack("!Bi", COMPOUND, count) + content


def packed(function: str, answer: Any) -> bytes:
    """Return an answer of libsumo as a typed value, as SUMO's own server packs it.

    Args:
        function: the function of libsumo, which decides the form where the type of its answer does
            not.
        answer: its return value.

    Raises:
        ProtocolError: for an answer without a form.
    """
    name = function.partition(".")[2]
    try:
        if name in FIELDS:
            return compound(len(FIELDS[name]), pack(FIELDS[name], *(answer or NO_VEHICLE)))
        if name in ROWS:
            form, values = ROWS[name]
            content = pack("i", len(answer))
            for row in answer:
                content += pack(form, *values(row))
            return compound(1 + len(answer) * len(form), content)
        if name == "getNeighbors":
            content = b""
            for neighbour, gap_m in answer:
                content += string(neighbour) + struct.pack("!d", gap_m)
            return compound(len(answer), content)
        return pack("p" if name in POLYGONS else _form_of(answer), answer)
    except (TypeError, ValueError, AttributeError, struct.error) as error:
        raise ProtocolError("the type of its answer is not supported") from error


def _form_of(answer: Any) -> str:
    if isinstance(answer, str):
        return "s"
    if isinstance(answer, float):
        return "d"
    if not isinstance(answer, tuple):
        return "i"
    if all(isinstance(item, str) for item in answer):
        return "l"
    if len(answer) == 4 and all(isinstance(item, int) for item in answer):
        return "c"
    return {2: "o", 3: "O"}.get(len(answer), "f")


NO_VEHICLE = "", -1.0
"""The leader or follower of a vehicle that has none."""
FIELDS = {
    "getLeader": "sd",
    "getFollower": "sd",
    "getLaneChangeState": "ii",
    "getParameterWithKey": "ss",
}
"""Letters of `pack` of the answers that are one compound, by function."""
POLYGONS = ("getShape", "getNetBoundary")
STOP = "lane endPos stoppingPlaceID stopFlags duration until"
STOPS = f"{STOP} startPos intendedArrival arrival depart split join actType tripId line speed"
COLLISION = "collider victim colliderType victimType colliderSpeed victimSpeed type lane pos"
LINK = "ssBBBssd", itemgetter(0, 4, 1, 2, 3, 5, 6, 7)
"""libsumo has the lane inside the junction at another position than the wire."""
ROWS: dict[str, tuple[str, Callable[[Any], Any]]] = {
    "getBestLanes": ("sddbBl", tuple),
    "getJunctionFoes": ("sddddssBB", tuple),
    "getNextStops": ("sdsidd", attrgetter(*STOP.split())),
    "getStops": ("sdsiddddddsssssd", attrgetter(*STOPS.split())),
    "getCollisions": ("ssssddssd", attrgetter(*COLLISION.split())),
    "getNextLinks": LINK,
    "getLinks": LINK,
    # libsumo has the state of a light as a letter, the wire as its number.
    "getNextTLS": ("sidb", lambda light: (*light[:3], ord(light[3]))),
}
"""Of answers that are rows, the letters of a row, and a function that gives its values."""
