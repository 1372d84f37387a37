"""A SUMO net of a map in OpenStreetMap's or OpenDRIVE's format, by netconvert.

A map is data that somebody sent: netconvert gets what is listed here of it and no more, as a file
in a folder of its own. Of OpenDRIVE that is the reference line, lanes, links and junctions; the
projection is left out, as its text may name files.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Final

from merge_sumo.errors import UserError
from merge_sumo.road import received
from merge_sumo.road.received import Allowed, matching, number
from merge_sumo.sumo.binding import run_program, scratch_folder
from merge_sumo.system.printable import printable, quoted

OSM: Final = ".osm"
OPENDRIVE: Final = ".xodr"
CONVERT_LIMIT_S: Final = 120.0
"""Time that netconvert has for a map: it takes seconds for that of a town."""
MAX_ELEMENTS: Final = 2 * 10**6
"""Of a map: that of a town has half as many."""

_ID: Final = matching(r"-?\d{1,20}", "a whole number")
_TEXT: Final = matching(r"[^\x00-\x08]*", "a text")
_WORD: Final = matching(r"[\w.:+-]{0,200}", "letters, digits and . : + -")
_UNIT: Final = matching(r"(?:m/s|km/h|mph)?", "m/s, km/h or mph")
_LENGTH: Final = number(-1e7, 1e7)
_TAG: Final = {"tag": Allowed({"k": _TEXT, "v": _TEXT}, required=("k", "v"))}
_MEMBER: Final = Allowed({"type": _WORD, "ref": _ID, "role": _TEXT})
_NODE: Final = {"id": _ID, "lat": number(-90.0, 90.0), "lon": number(-180.0, 180.0)}

OSM_MAP: Final[Mapping[str, Allowed]] = {
    "osm": Allowed(
        {"version": _WORD},
        {
            "node": Allowed(_NODE, _TAG, ("id", "lat", "lon")),
            "way": Allowed({"id": _ID}, {"nd": Allowed({"ref": _ID}), **_TAG}, ("id",)),
            "relation": Allowed({"id": _ID}, {"member": _MEMBER, **_TAG}, ("id",)),
        },
    )
}
"""What netconvert is given of a map of OpenStreetMap."""


def _numbers(*names: str) -> dict[str, received.Values]:
    return dict.fromkeys(names, _LENGTH)


_CUBIC: Final = ("a", "b", "c", "d")
_END: Final = {"elementType": _WORD, "elementId": _TEXT, "contactPoint": _WORD, "id": _TEXT}
_LINK: Final = Allowed({}, {"predecessor": Allowed(_END), "successor": Allowed(_END)})
_SPEED: Final = {"s": _LENGTH, "sOffset": _LENGTH, "max": _TEXT, "unit": _UNIT}
_LANE: Final = Allowed(
    {"id": _ID, "type": _WORD, "level": _WORD},
    {
        "link": _LINK,
        "width": Allowed(_numbers("sOffset", *_CUBIC)),
        "border": Allowed(_numbers("sOffset", *_CUBIC)),
        "speed": Allowed(_SPEED),
        "access": Allowed({"sOffset": _LENGTH, "restriction": _WORD, "rule": _WORD}),
    },
)
_SIDE: Final = Allowed({}, {"lane": _LANE})
_GEOMETRY: Final = Allowed(
    _numbers("s", "x", "y", "hdg", "length"),
    {
        "line": Allowed(),
        "arc": Allowed(_numbers("curvature")),
        "spiral": Allowed(_numbers("curvStart", "curvEnd")),
        "poly3": Allowed(_numbers(*_CUBIC)),
        "paramPoly3": Allowed(
            {**_numbers(*(f"{c}{axis}" for axis in "UV" for c in _CUBIC)), "pRange": _WORD}
        ),
    },
)
_ROAD: Final = Allowed(
    {"name": _TEXT, "length": _LENGTH, "id": _TEXT, "junction": _TEXT, "rule": _WORD},
    {
        "link": _LINK,
        "type": Allowed({"s": _LENGTH, "type": _WORD}, {"speed": Allowed(_SPEED)}),
        "planView": Allowed({}, {"geometry": _GEOMETRY}),
        "elevationProfile": Allowed({}, {"elevation": Allowed(_numbers("s", *_CUBIC))}),
        "lanes": Allowed(
            {},
            {
                "laneOffset": Allowed(_numbers("s", *_CUBIC)),
                "laneSection": Allowed(
                    {"s": _LENGTH, "singleSide": _WORD},
                    {"left": _SIDE, "center": _SIDE, "right": _SIDE},
                ),
            },
        ),
    },
    ("id", "length"),
)
_CONNECTION: Final = Allowed(
    {"id": _TEXT, "incomingRoad": _TEXT, "connectingRoad": _TEXT, "contactPoint": _WORD},
    {"laneLink": Allowed({"from": _ID, "to": _ID})},
)
OPENDRIVE_MAP: Final[Mapping[str, Allowed]] = {
    "OpenDRIVE": Allowed(
        {},
        {
            "header": Allowed({"revMajor": _WORD, "revMinor": _WORD}),
            "road": _ROAD,
            "junction": Allowed({"id": _TEXT, "name": _TEXT}, {"connection": _CONNECTION}),
        },
    )
}
"""What netconvert is given of a road network in OpenDRIVE."""

KINDS: Final = {
    OSM: ("--osm-files", OSM_MAP, ("--geometry.remove", "true")),
    OPENDRIVE: ("--opendrive-files", OPENDRIVE_MAP, ()),
}
"""The option of netconvert for maps of a kind, what is read of them, and further options."""
OPTIONS: Final = ("--keep-edges.by-vclass", "passenger", "--no-turnarounds", "true")
_COMMENT: Final = re.compile(rb"\s*<!--.*?-->", re.DOTALL)


def is_map(path: Path) -> bool:
    """Return whether a file is a map by its name, of which a net can be made."""
    return _kind(path) is not None


def _kind(path: Path) -> str | None:
    name = path.name.casefold().removesuffix(".xml")
    return next((suffix for suffix in KINDS if name.endswith(suffix)), None)


def command_for(path: Path) -> str:
    """Return the command with which a person makes a net of a map, to look at it in netedit."""
    option, _, more = KINDS[_kind(path) or OSM]
    stem = path.name.split(".")[0]
    words = [option, quoted(path), *OPTIONS, *more, "--output-file", quoted(f"{stem}.net.xml")]
    return f"netconvert {' '.join(words)}"


def net_of_map(path: Path) -> bytes:
    """Return the SUMO net of a map; the same map gives the same bytes.

    Raises `UserError` where it cannot be read, is no such map, or netconvert makes no net of it.
    """
    option, schema, more = KINDS[_kind(path) or OSM]
    limit = received.MAX_NET_BYTES
    content = received.read_bytes(path, "the map", follow_links=True, limit=limit)
    root, _ = received.parse(content, schema, f"the map {path}", MAX_ELEMENTS)
    with scratch_folder() as stage:
        (stage / "map.xml").write_bytes(received.serialize(root))
        arguments = [option, "map.xml", *OPTIONS, *more, "--output-file", "made.net.xml"]
        arguments += ["--no-warnings", "true", "--xml-validation", "never"]
        ended = run_program("netconvert", arguments, stage, CONVERT_LIMIT_S)
        made = stage / "made.net.xml"
        if ended.code == 0 and made.is_file():
            net = received.read_bytes(made, "the net", follow_links=False, limit=limit)
            return _COMMENT.sub(b"", net, count=1)  # it holds the date
    raise UserError(
        f"netconvert makes no net of the map {path}: {printable(ended.reason)[:200]}; look at it "
        f"with `{command_for(path)}`"
    )
