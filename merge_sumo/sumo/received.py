"""XML that somebody sent: read as data, with nothing left of it but what this page allows.

SUMO's files can name other files, devices and addresses, and SUMO reads and writes all of them.
So no file that came from outside reaches SUMO or netconvert. It is read here, without opening what
is no plain file, without entities and within limits, and what goes on is a tree of the elements
and attributes below. What is not below is dropped, since the scenario needs none of it; a value
that is not what its attribute holds is refused, since dropping it would change the road or the
record.
"""

from __future__ import annotations

import codecs
import os
import re
import stat
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from lxml import etree

from merge_sumo.errors import UserError

MAX_BYTES: Final = 4 * 2**20
MAX_NET_BYTES: Final = 2**28
"""Of a net that a user names: that of a city has 50 MB. What somebody sent is a corridor."""
MAX_ELEMENTS: Final = 5_000
"""A corridor has some twenty and a record less than a thousand; a world has its net 32 times."""
MAX_CHARS: Final = 2**16
"""Of the value of an attribute."""
MAX_NUMBER_CHARS: Final = 64

_NUMBER: Final = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)
_PLAIN_DECLARATION: Final = re.compile(
    rb"""<\?xml version=["']1\.0["'] encoding=["'](?:UTF|utf)-8["'] ?\?>"""
)


@dataclass(frozen=True, slots=True)
class Values:
    """What an attribute may hold: a test, and the words for it in a sentence."""

    words: str
    include: Callable[[str], bool]


@dataclass(frozen=True, slots=True)
class Allowed:
    """What an element may have; what it must have is named in `required`."""

    attributes: Mapping[str, Values] = field(default_factory=dict)
    children: Mapping[str, Allowed] = field(default_factory=dict)
    required: tuple[str, ...] = ()


def number(low: float, high: float) -> Values:
    """Return the finite numbers from `low` to `high`."""
    return Values(f"a number from {low:g} to {high:g}", lambda text: _is_number(text, low, high))


def matching(pattern: str, words: str) -> Values:
    """Return the texts that match a pattern as a whole.

    No two of its repetitions may compete for the same characters: that would take for ever.
    """
    compiled = re.compile(pattern)
    return Values(words, lambda text: compiled.fullmatch(text) is not None)


def _is_number(text: str, low: float, high: float) -> bool:
    short = len(text) <= MAX_NUMBER_CHARS and _NUMBER.fullmatch(text) is not None
    return short and low <= float(text) <= high


def _are_points(text: str) -> bool:
    points = [point.split(",") for point in text.split(" ") if point]
    return all(
        len(point) in (2, 3) and all(_is_number(part, -MAX_M, MAX_M) for part in point)
        for point in points
    )


MAX_M: Final = 2e7
"""Farthest from the origin that a net may reach: half way round the earth, in metres of UTM."""
_SWITCH = matching("0|1|true|false", "0, 1, true or false")
_COUNT = number(0, 10_000)
_METRES = number(0, MAX_M)
_PLACE = number(-MAX_M, MAX_M)
_EARTH_M = r"[+-]?[0-9]{1,12}(?:\.[0-9]{0,12})?"
_SPEED = number(0, 1000)
_ID = matching(r"[\w.:#+\-]{1,250}", "an id of letters, digits and . : # + - _")
_IDS = Values("a list of ids", lambda text: all(map(_ID.include, text.split())))
_WORD = matching(r"[A-Za-z_]{1,40}", "a word")
_CLASSES = matching(r"[a-z_0-9 ]*", "a list of vehicle classes")
_SHAPE = Values(f"points x,y within {MAX_M:g} m", _are_points)
_BITS = matching("[01]{1,256}", "a row of 0 and 1")
_NAME = Values("a name", lambda text: len(text) <= 200 and text.isprintable())

_PROJECTION = matching(
    r"[!.\-]|(?:\+(?:no_defs|south|(?:proj|zone|ellps|datum|units|lat_0|lat_1|lat_2|lat_ts|lon_0|k|k_0"
    r"|x_0|y_0|type|towgs84)=[A-Za-z0-9.,\-]{1,80})(?: |$))+",
    "a projection that names no file",
)

_LANE: Final = Allowed(
    {
        **dict.fromkeys(("id", "type"), _ID),
        **dict.fromkeys(("allow", "disallow", "changeLeft", "changeRight"), _CLASSES),
        **dict.fromkeys(("acceleration", "customShape"), _SWITCH),
        **{"index": _COUNT, "speed": _SPEED, "length": _METRES, "shape": _SHAPE},
        **{"width": number(0.01, 100), "endOffset": _METRES},
    }
)
_EDGE: Final = Allowed(
    {
        **dict.fromkeys(("id", "from", "to", "bidi"), _ID),
        **dict.fromkeys(("function", "spreadType"), _WORD),
        "crossingEdges": _IDS,
        **{"length": _METRES, "distance": _PLACE},
        **{"priority": number(-1000, 1000), "name": _NAME, "shape": _SHAPE},
        "type": matching(r"[\w.:#+|\-]{0,250}", "an edge type"),
    },
    {"lane": _LANE},
)
_JUNCTION: Final = Allowed(
    {
        **dict.fromkeys(("id",), _ID),
        **dict.fromkeys(("type", "rightOfWay", "fringe", "roundabout"), _WORD),
        **dict.fromkeys(("x", "y", "z"), _PLACE),
        **dict.fromkeys(("incLanes", "intLanes"), _IDS),
        **dict.fromkeys(("customShape", "keepClear"), _SWITCH),
        **{"shape": _SHAPE, "radius": number(-1, 1e4), "name": _NAME},
    },
    {"request": Allowed({"index": _COUNT, "response": _BITS, "foes": _BITS, "cont": _SWITCH})},
)
_CONNECTION: Final = Allowed(
    {
        **dict.fromkeys(("from", "to"), _ID),
        **dict.fromkeys(("fromLane", "toLane"), _COUNT),
        **dict.fromkeys(("pass", "keepClear", "uncontrolled", "indirect"), _SWITCH),
        **dict.fromkeys(("allow", "disallow", "changeLeft", "changeRight"), _CLASSES),
        **dict.fromkeys(("contPos", "visibility", "length"), _PLACE),
        **{"speed": number(-1, 1000), "shape": _SHAPE},
        "dir": matching("[a-zA-Z]|invalid", "a letter"),
        "state": matching("[a-zA-Z=-]", "a letter, = or -"),
    }
)
_VERSION = matching(r"[0-9]{1,4}(?:\.[0-9]{1,4}){0,3}", "a version")
NET: Final = {
    "net": Allowed(
        {
            "version": _VERSION,
            "junctionCornerDetail": number(0, 1000),
            "junctionLinkDetail": number(0, 1000),
            "limitTurnSpeed": number(-1, 1000),
            **dict.fromkeys(("lefthand", "rectangularLaneCut", "avoidOverlap"), _SWITCH),
            **dict.fromkeys(("walkingareas", "checkLaneFoes.all"), _SWITCH),
            **dict.fromkeys(("checkLaneFoes.roundabout",), _SWITCH),
            "spreadType": _WORD,
            # A reader that validates fetches what stands here.
            "{http://www.w3.org/2001/XMLSchema-instance}noNamespaceSchemaLocation": matching(
                r"https?://sumo\.dlr\.de/xsd/net_file\.xsd", "the schema of SUMO's nets"
            ),
        },
        {
            "location": Allowed(
                {
                    "netOffset": matching(f"{_EARTH_M},{_EARTH_M}", "x,y"),
                    "convBoundary": matching(f"(?:{_EARTH_M},){{3}}{_EARTH_M}", "four numbers"),
                    "origBoundary": matching(f"(?:{_EARTH_M},){{3}}{_EARTH_M}", "four numbers"),
                    "projParameter": _PROJECTION,
                }
            ),
            "edge": _EDGE,
            "junction": _JUNCTION,
            "connection": _CONNECTION,
        },
    )
}
"""A net: no traffic lights, types, roundabouts or parameters, which a corridor does without."""
HOSTED_NET: Final = {
    "net": Allowed(
        {"version": _VERSION},
        {
            "edge": _EDGE,
            "junction": _JUNCTION,
            "connection": Allowed({**_CONNECTION.attributes, "via": _ID}),
        },
    )
}
"""A net that `hosting` made, with lanes inside of junctions."""

_WHO: Final = matching("pov|vut", "pov or vut")
_COLOUR: Final = matching(r"[0-9.]{1,20}(?:,[0-9.]{1,20}){2,3}|[a-z]{1,20}", "a colour")

TYPES: Final = {
    "additional": Allowed(
        {},
        {
            "vType": Allowed(
                {
                    "id": _WHO,
                    "color": _COLOUR,
                    "guiShape": matching("[a-z]{1,20}(?:/[a-z]{1,20})?", "a shape of a vehicle"),
                    "length": number(0.1, 100),
                    "minGap": number(0, 100),
                    **dict.fromkeys(("maxSpeed", "speedFactor"), number(1e-9, 1000)),
                    **dict.fromkeys(("decel", "emergencyDecel"), number(0.1, 1e4)),
                },
                required=("id",),
            )
        },
    )
}
"""The types of the two vehicles; SUMO chooses what is not named."""

SURROUNDINGS: Final = {
    "additional": Allowed(
        {},
        {
            "poly": Allowed(
                {
                    "id": _ID,
                    "color": _COLOUR,
                    "fill": _SWITCH,
                    "layer": number(-1000, 1000),
                    "lineWidth": number(0, 100),
                    "shape": _SHAPE,
                },
                required=("id", "shape"),
            )
        },
    )
}
"""What is drawn beside the road."""

_MOTION: Final = {
    "id": _WHO,
    "x": _PLACE,
    "y": _PLACE,
    "pos": _METRES,
    "speed": _SPEED,
}
_RECORDED: Final = {
    **_MOTION,
    "angle": number(-360, 360),
    "type": _WHO,
    "lane": matching(
        "(?:main_in|main_out|ramp)_0"
        r"|(?::(?:M|end|(?:main|ramp|out)[0-9]{1,4}-end)\.0_(?:main|ramp|out)[0-9]{1,4}"
        r"|(?:main|ramp|out)[0-9]{1,4}\.0)_0",
        "a lane of a replay",
    ),
}


def _fcd(vehicle: Mapping[str, Values]) -> Mapping[str, Allowed]:
    step = Allowed(
        {"time": number(0, 1e4)},
        {"vehicle": Allowed(vehicle, required=tuple(vehicle))},
        required=("time",),
    )
    return {"fcd-export": Allowed({}, {"timestep": step})}


RECORD: Final = _fcd(_RECORDED)
"""The record that SUMO plays."""
REPLAYED: Final = _fcd(_MOTION)
"""What SUMO writes of a replay, where only motion is compared."""


def read_bytes(path: Path, what: str, *, follow_links: bool, limit: int = MAX_BYTES) -> bytes:
    """Return the bytes of a plain file of at most `limit`.

    Raises `UserError` for anything else that a path can be, without opening it: opening a FIFO
    waits, and opening a device may do something. `what` is what sentences call the file.
    """
    flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
    flags |= 0 if follow_links else getattr(os, "O_NOFOLLOW", 0)
    try:
        mode = path.stat(follow_symlinks=follow_links).st_mode
        if stat.S_ISREG(mode):
            with open(path, "rb", opener=lambda name, _: os.open(name, flags)) as file:
                # Asked again, because another may stand there now.
                mode = os.fstat(file.fileno()).st_mode
                content = file.read(limit + 1) if stat.S_ISREG(mode) else b""
    except OSError as error:
        raise UserError(f"cannot read {what} {path}: {error.strerror}") from error
    if stat.S_ISLNK(mode):
        raise UserError(f"cannot read {what} {path}: it is a link; put the file itself there")
    if not stat.S_ISREG(mode):
        raise UserError(f"cannot read {what} {path}: it is no plain file")
    if len(content) > limit:
        raise UserError(f"cannot read {what} {path}: it is larger than {limit // 2**20} MiB")
    return content


def check_text(content: bytes, name: str) -> None:
    """Raise `UserError` for bytes that are no UTF-8, or declare what a reader could expand."""
    try:
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"{name} is not readable XML: save it as UTF-8") from error
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise UserError(f"{name} declares a document type or an entity: remove the declaration")


def parse(
    content: bytes,
    allowed: Mapping[str, Allowed],
    name: str,
    max_elements: int = MAX_ELEMENTS,
) -> tuple[etree._Element, bool]:
    """Return what is allowed of an XML file as a tree, and whether that is all of it.

    Where it is all, the bytes themselves mean the same to every reader as the tree does: comments
    and spaces are the only things that are in the one and not in the other.

    Raises `UserError` when it is no UTF-8, is no XML, declares a document type, has more elements
    than `max_elements`, or has a value that its attribute does not take; `name` is what the
    sentence calls it.
    """
    check_text(content, name)
    cleaner = _Cleaner(allowed, name, max_elements)
    parser = etree.XMLParser(
        target=cleaner,  # type: ignore[arg-type] # the stubs know parsers of bytes, too
        # Whatever the file declares: another encoding could hide what is looked for above.
        encoding="utf-8",
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
    )
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        said = str(error.msg).encode("ascii", "backslashreplace").decode()
        raise UserError(f"{name} is not readable XML: {said:.200}") from error
    text = content.removeprefix(codecs.BOM_UTF8)
    plain = not text.startswith(b"<?xml") or _PLAIN_DECLARATION.match(text) is not None
    return root, plain and cleaner.intact


def serialize(root: etree._Element) -> bytes:
    """Return a tree as an XML file."""
    etree.indent(root, space="    ")
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")


class _Cleaner:
    """Builds the tree of what is allowed while the parser reads, and holds nothing else."""

    def __init__(self, allowed: Mapping[str, Allowed], name: str, max_elements: int) -> None:
        self.intact = True
        self._name, self._max_elements = name, max_elements
        self._elements = 0
        self._dropped = 0
        """Depth inside of an element that is dropped."""
        self._root: etree._Element | None = None
        self._open: list[tuple[etree._Element | None, Mapping[str, Allowed]]] = [(None, allowed)]

    def start(self, tag: str, attributes: Mapping[str, str]) -> None:
        self._elements += 1
        if self._elements > self._max_elements:
            raise UserError(f"{self._name} has more than {self._max_elements} elements")
        parent, expected = self._open[-1]
        if self._dropped or tag not in expected:
            if parent is None:
                raise UserError(f"{self._name} has another root than <{next(iter(expected))}>")
            self._dropped += 1
            self.intact = False
            return
        allowed = expected[tag]
        kept = {name: text for name, text in attributes.items() if name in allowed.attributes}
        self.intact &= len(kept) == len(attributes)
        for name, text in kept.items():
            values = allowed.attributes[name]
            if not (len(text) <= MAX_CHARS and values.include(text)):
                local = name.rpartition("}")[2]
                raise UserError(
                    f"{self._name} has an element {tag} whose {local} is not {values.words}"
                )
        for name in allowed.required:
            if name not in kept:
                raise UserError(f"{self._name} has an element {tag} without {name}")
        element = etree.Element(tag) if parent is None else etree.SubElement(parent, tag)
        for name, text in kept.items():
            element.set(name, text)
        if parent is None:
            self._root = element
        self._open.append((element, allowed.children))

    def end(self, tag: str) -> None:
        if self._dropped:
            self._dropped -= 1
        else:
            self._open.pop()

    def data(self, data: str) -> None:
        self.intact &= not data.strip()

    def pi(self, target: str, data: str | None = None) -> None:
        self.intact = False

    def comment(self, text: str) -> None:
        pass

    def close(self) -> etree._Element | None:
        return self._root
