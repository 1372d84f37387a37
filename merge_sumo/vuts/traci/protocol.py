"""The bytes of TraCI, the protocol by which a program controls SUMO; no sockets here.

A message is a length and commands; a command is a length, an identifier and a payload; numbers are
big-endian (https://sumo.dlr.de/docs/TraCI/Protocol.html). Bytes that are not that raise
`ProtocolError` and nothing else, whatever they are.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Final

MAX_MESSAGE_BYTES: Final = 1 << 20
"""A controller of one vehicle never says more at a time; garbage read as a length mostly does."""

POSITION_LON_LAT: Final = 0x00
POSITION_2D: Final = 0x01
POSITION_LON_LAT_ALT: Final = 0x02
POSITION_ROADMAP: Final = 0x04
POSITION_3D: Final = 0x03
TYPE_POLYGON: Final = 0x06
TYPE_UBYTE: Final = 0x07
TYPE_BYTE: Final = 0x08
TYPE_INTEGER: Final = 0x09
TYPE_DOUBLE: Final = 0x0B
TYPE_STRING: Final = 0x0C
TYPE_STRINGLIST: Final = 0x0E
TYPE_COMPOUND: Final = 0x0F
TYPE_DOUBLELIST: Final = 0x10
TYPE_COLOR: Final = 0x11

OK: Final = 0x00
NOT_IMPLEMENTED: Final = 0x01
ERROR: Final = 0xFF

_FIXED: Final = {
    POSITION_LON_LAT: struct.Struct("!dd"),
    POSITION_2D: struct.Struct("!dd"),
    POSITION_LON_LAT_ALT: struct.Struct("!ddd"),
    POSITION_3D: struct.Struct("!ddd"),
    TYPE_UBYTE: struct.Struct("!B"),
    TYPE_BYTE: struct.Struct("!b"),
    TYPE_INTEGER: struct.Struct("!i"),
    TYPE_DOUBLE: struct.Struct("!d"),
    TYPE_COLOR: struct.Struct("!BBBB"),
}
POSITIONS: Final = frozenset({POSITION_LON_LAT, POSITION_2D, POSITION_LON_LAT_ALT, POSITION_3D})
_UBYTE, _INT, _DOUBLE = (_FIXED[t] for t in (TYPE_UBYTE, TYPE_INTEGER, TYPE_DOUBLE))
_MAX_NESTING: Final = 4


class ProtocolError(Exception):
    """Bytes that are not TraCI; the text says what is wrong with them."""


@dataclass(frozen=True, slots=True)
class Command:
    """A command of a message: its identifier and its payload."""

    identifier: int
    payload: bytes


class Reader:
    """Reads values from bytes, one after the other."""

    def __init__(self, data: bytes) -> None:
        """Start at the first byte."""
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

    def typed(self, nesting: int = 0) -> Any:
        """Return the next value with a type before it; compounds and lists as tuples."""
        return self._of_type(self.ubyte(), nesting)

    def arguments(self, nesting: int = 0) -> list[Any]:
        """Return the values that are left, in order.

        Those of compounds and positions stand one by one, lists and colours are one value each.
        """
        found: list[Any] = []
        while self.left:
            kind = self.ubyte()
            if kind == TYPE_COMPOUND:
                if nesting >= _MAX_NESTING:
                    raise ProtocolError("compounds are nested too deeply")
                self._count(1)
                nesting += 1
            elif kind == POSITION_ROADMAP or kind in POSITIONS:
                found += self._place(kind)
            else:
                found.append(self._of_type(kind, nesting))
        return found

    def place(self) -> tuple[int, list[Any]]:
        """Return the type of the next value, a position, and what it is made of."""
        kind = self.ubyte()
        return kind, self._place(kind)

    def _place(self, kind: int) -> list[Any]:
        if kind == POSITION_ROADMAP:
            return [self.string(), self.double(), self.ubyte()]
        if kind not in POSITIONS:
            raise ProtocolError(f"a position was expected, not type 0x{kind:02x}")
        return list(_FIXED[kind].unpack(self.raw(_FIXED[kind].size)))

    def _of_type(self, kind: int, nesting: int) -> Any:
        """Return the next value, whose type has been read."""
        if kind in _FIXED:
            form = _FIXED[kind]
            values = form.unpack(self.raw(form.size))
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
            return tuple(self.typed(nesting + 1) for _ in range(self._count(1)))
        raise ProtocolError(f"there is no type 0x{kind:02x} that a controller could send")

    def typed_double(self) -> float:
        """Return the next value, which must be a double."""
        value = self.typed()
        if not isinstance(value, float):
            raise ProtocolError(f"a double was expected, not {value!r:.40}")
        return value

    def _count(self, smallest: int) -> int:
        """Return a number of items that can be there, each of at least `smallest` bytes."""
        count = self.integer()
        if not 0 <= count * smallest <= self.left:
            raise ProtocolError(f"{count} items were announced where {self.left} bytes are left")
        return count


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


def raw_integer(value: int) -> bytes:
    """Return an integer without its type."""
    return _INT.pack(value)


def raw_double(value: float) -> bytes:
    """Return a double without its type."""
    return _DOUBLE.pack(value)


def raw_string(value: str) -> bytes:
    """Return a string without its type."""
    encoded = value.encode("utf-8")
    return _INT.pack(len(encoded)) + encoded


def ubyte(value: int) -> bytes:
    """Return a typed unsigned byte."""
    return bytes((TYPE_UBYTE, value))


def integer(value: int) -> bytes:
    """Return a typed integer."""
    return bytes((TYPE_INTEGER,)) + _INT.pack(value)


def double(value: float) -> bytes:
    """Return a typed double."""
    return bytes((TYPE_DOUBLE,)) + _DOUBLE.pack(value)


def string(value: str) -> bytes:
    """Return a typed string."""
    return bytes((TYPE_STRING,)) + raw_string(value)


def strings(values: Sequence[str]) -> bytes:
    """Return a typed list of strings."""
    items = b"".join(map(raw_string, values))
    return bytes((TYPE_STRINGLIST,)) + _INT.pack(len(values)) + items


def position(*coordinates: float) -> bytes:
    """Return a typed position of two or three coordinates."""
    kind = POSITION_2D if len(coordinates) == 2 else POSITION_3D
    return bytes((kind,)) + _FIXED[kind].pack(*coordinates)


def polygon(points: Sequence[tuple[float, float]]) -> bytes:
    """Return a typed list of points; a count above 255 stands behind a 0."""
    items = b"".join(struct.pack("!dd", *point) for point in points)
    few = len(points) < 256
    count = bytes((len(points),)) if few else bytes((0,)) + _INT.pack(len(points))
    return bytes((TYPE_POLYGON,)) + count + items


def byte(value: int) -> bytes:
    """Return a typed signed byte."""
    return bytes((TYPE_BYTE, value & 0xFF))


def doubles(values: Sequence[float]) -> bytes:
    """Return a typed list of doubles."""
    items = struct.pack(f"!{len(values)}d", *values)
    return bytes((TYPE_DOUBLELIST,)) + _INT.pack(len(values)) + items


def road_position(edge: str, position_m: float, lane: int) -> bytes:
    """Return a typed position on a lane of an edge."""
    place = raw_string(edge) + _DOUBLE.pack(position_m) + bytes((lane,))
    return bytes((POSITION_ROADMAP,)) + place


def colour(*channels: int) -> bytes:
    """Return a typed colour of four channels."""
    return bytes((TYPE_COLOR, *channels))


def compound(*typed: bytes) -> bytes:
    """Return typed values as one."""
    return bytes((TYPE_COMPOUND,)) + _INT.pack(len(typed)) + b"".join(typed)


def compound_list(items: Sequence[Sequence[bytes]]) -> bytes:
    """Return items of typed values as one: their number, and the values of all."""
    return compound(integer(len(items)), *(value for item in items for value in item))
