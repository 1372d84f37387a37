"""The bytes of TraCI, the protocol by which a program controls SUMO; no sockets here.

A message is a length and commands; a command is a length, an identifier and a payload; numbers are
big-endian (https://sumo.dlr.de/docs/TraCI/Protocol.html). Bytes that are not that raise
`ProtocolError` and nothing else, whatever they are.
"""

from __future__ import annotations

import struct
from typing import Any, Final, NamedTuple

from merge_sumo.sumo.binding import SUMO_VERSION
from merge_sumo.sumo.traci_names import packer

MAX_MESSAGE_BYTES: Final = 1 << 20
"""A controller of one vehicle never says more at a time; garbage read as a length mostly does."""
API_VERSION: Final = 22
"""Of the TraCI of SUMO 1.28."""

GET_VERSION, SIMULATION_STEP, SET_ORDER, CLOSE = 0x00, 0x02, 0x03, 0x7F
GET_VEHICLE, GET_JUNCTION, GET_SIMULATION, SET_VEHICLE = 0xA4, 0xA9, 0xAB, 0xC4
"""Identifiers of commands."""

TYPE_UBYTE, TYPE_BYTE, TYPE_INTEGER, TYPE_DOUBLE = 0x07, 0x08, 0x09, 0x0B
TYPE_STRING, TYPE_STRINGLIST, TYPE_COMPOUND, TYPE_DOUBLELIST, TYPE_COLOR = 0x0C, *range(0x0E, 0x12)
"""Types of values."""
LON_LAT, ROADMAP = 0x00, 0x04
"""Types of positions that are no points of the plane or of space, 0x01 and 0x03."""
PLACES: Final = "goGOr"
"""The letters of `pack` by the types of positions: on earth, in the plane, both with height, and on
a road."""
OK, NOT_IMPLEMENTED, ERROR = 0x00, 0x01, 0xFF
"""Results of commands."""

_FIXED: Final = {
    TYPE_UBYTE: struct.Struct("!B"),
    TYPE_BYTE: struct.Struct("!b"),
    TYPE_INTEGER: struct.Struct("!i"),
    TYPE_DOUBLE: struct.Struct("!d"),
    TYPE_COLOR: struct.Struct("!BBBB"),
}
_INT, _DOUBLE = _FIXED[TYPE_INTEGER], _FIXED[TYPE_DOUBLE]
_MAX_NESTING: Final = 4


class ProtocolError(Exception):
    """Bytes that are not TraCI; the text says what is wrong with them."""


class Command(NamedTuple):
    """A command of a message."""

    identifier: int
    payload: bytes


class Reader:
    """Reads values from bytes, one after the other."""

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._at = 0

    @property
    def left(self) -> int:
        """Bytes that have not been read."""
        return len(self._data) - self._at

    def raw(self, count: int) -> bytes:
        """Return the next `count` bytes."""
        if not 0 <= count <= self.left:
            raise ProtocolError(f"{count} bytes were announced where {self.left} are left")
        start, self._at = self._at, self._at + count
        return self._data[start : self._at]

    def ubyte(self) -> int:
        """Return the next unsigned byte."""
        return self.raw(1)[0]

    def integer(self) -> int:
        """Return the next 32-bit integer."""
        value: int = _INT.unpack(self.raw(4))[0]
        return value

    def double(self) -> float:
        """Return the next double."""
        value: float = _DOUBLE.unpack(self.raw(8))[0]
        return value

    def string(self) -> str:
        """Return the next string."""
        try:
            return self.raw(self.integer()).decode("utf-8")
        except UnicodeDecodeError as error:
            raise ProtocolError("a string is not UTF-8") from error

    def count(self) -> int:
        """Return of how many values the compound is made whose type is next."""
        if self.ubyte() != TYPE_COMPOUND:
            raise ProtocolError("there is no compound where one is due")
        return self._count(1)

    def place(self) -> tuple[int, list[Any]]:
        """Return the type and the coordinates of the position that is next."""
        kind = self.ubyte()
        if kind == ROADMAP:
            return kind, [self.string(), self.double(), self.ubyte()]
        if kind >= len(PLACES):
            raise ProtocolError(f"type 0x{kind:02x} is no position")
        return kind, [self.double() for _ in range(2 if PLACES[kind] in "go" else 3)]

    def typed(self, nesting: int = 0) -> Any:
        """Return the next value with a type before it.

        Lists and colours are tuples; compounds are lists of what they are made of.
        """
        kind = self.ubyte()
        if kind in _FIXED:
            values = _FIXED[kind].unpack(self.raw(_FIXED[kind].size))
            return values[0] if len(values) == 1 else values
        if kind == TYPE_STRING:
            return self.string()
        if kind == TYPE_STRINGLIST:
            return tuple(self.string() for _ in range(self._count(4)))
        if kind == TYPE_DOUBLELIST:
            return tuple(self.double() for _ in range(self._count(8)))
        if kind == TYPE_COMPOUND:
            if nesting >= _MAX_NESTING:
                raise ProtocolError("compounds are nested too deeply")
            return [self.typed(nesting + 1) for _ in range(self._count(1))]
        raise ProtocolError(f"there is no type 0x{kind:02x} that a controller could send")

    def typed_bytes(self) -> bytes:
        """Return the bytes of the next value with its type."""
        start = self._at
        self.typed()
        return self._data[start : self._at]

    def arguments(self) -> list[Any]:
        """Return the values that are left, in order; those of compounds singly."""
        values: list[Any] = []
        while self.left:
            values += _flat(self.typed())
        return values

    def _count(self, smallest: int) -> int:
        """Return a number of items that can be there, each of at least `smallest` bytes."""
        count = self.integer()
        if not 0 <= count * smallest <= self.left:
            raise ProtocolError(f"{count} items were announced where {self.left} bytes are left")
        return count


def _flat(value: Any) -> list[Any]:
    if not isinstance(value, list):
        return [value]
    return [inner for part in value for inner in _flat(part)]


def message_length(head: bytes) -> int:
    """Return the bytes that follow the first four of a message."""
    length: int = _INT.unpack(head)[0] - 4
    if not 0 <= length <= MAX_MESSAGE_BYTES:
        raise ProtocolError(f"a message of {length + 4} bytes was announced")
    return length


def commands_of(body: bytes) -> list[Command]:
    """Return the commands of a message without its first four bytes."""
    reader, commands = Reader(body), []
    while reader.left:
        length, head = reader.ubyte(), 1
        if length == 0:
            length, head = reader.integer(), 5
        if length <= head:
            raise ProtocolError(f"a command of {length} bytes was announced")
        content = reader.raw(length - head)
        commands.append(Command(content[0], content[1:]))
    if not commands:
        raise ProtocolError("a message has no command")
    return commands


def message(content: bytes) -> bytes:
    """Return what is sent: the content behind its length."""
    return _INT.pack(len(content) + 4) + content


def status(identifier: int, result: int = OK, text: str = "") -> bytes:
    """Return the answer that every command gets first.

    Clients read its length as one byte, so a long text is cut.
    """
    said = text.encode("utf-8")[:200].decode("utf-8", errors="ignore")
    return command(bytes((identifier, result)) + raw_string(said))


def command(content: bytes) -> bytes:
    """Return an identifier and its payload behind their length."""
    if len(content) < 255:
        return bytes((len(content) + 1,)) + content
    return b"\x00" + _INT.pack(len(content) + 5) + content


def raw_string(value: str) -> bytes:
    """Return a string without its type."""
    encoded = value.encode("utf-8")
    return _INT.pack(len(encoded)) + encoded


def raw_integer(value: int) -> bytes:
    """Return an integer without its type."""
    return _INT.pack(value)


def raw_double(value: float) -> bytes:
    """Return a double without its type."""
    return _DOUBLE.pack(value)


def pack(form: str, *values: Any) -> bytes:
    """Return typed values, one for each letter of `form`, as SUMO's own client packs them.

    Integer, double, string, signed and unsigned Byte, list of strings, list of floats, position in
    the plane (o) and in space (O), on earth (g, G) and on a road (r), colour, and polygon.
    """
    return packer()(form, *values)


def compound(count: int, content: bytes) -> bytes:
    """Return `count` typed values as one."""
    return bytes((TYPE_COMPOUND,)) + _INT.pack(count) + content


def version_answer() -> bytes:
    """Return the answer to the question for the version, behind its status."""
    text = raw_string(f"SUMO {SUMO_VERSION}, hosted by merge-sumo")
    return command(bytes((GET_VERSION,)) + raw_integer(API_VERSION) + text)
