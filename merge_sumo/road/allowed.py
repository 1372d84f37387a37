"""The elements, attributes and values that are allowed in the XML of roads, replays and records.

No scenario needs others.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

from lxml import etree

from merge_sumo.road.received import (
    MAX_NET_ELEMENTS,
    Allowed,
    Values,
    is_number,
    matching,
    number,
    parse,
)
from merge_sumo.scenario.scenario import VEHICLES


def _are_points(text: str) -> bool:
    points = [point.split(",") for point in text.split(" ") if point]
    return all(
        len(point) in (2, 3) and all(is_number(part, -MAX_M, MAX_M) for part in point)
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
_ID = matching(
    # As SUMO: "cluster_" with the ids of all that were joined is one, too.
    r"(?![./])[^\s|\\'\";,<>&]{1,4000}",
    "an id without spaces and | \\ ' \" ; , < > &, nor with . or / first",
)
_IDS = Values("a list of ids", lambda text: all(map(_ID.include, text.split())))
_WORD = matching(r"[A-Za-z_]{1,40}", "a word")
_CLASSES = matching(r"[a-z_0-9 ]*", "a list of vehicle classes")
_SHAPE = Values(f"points x,y within {MAX_M:g} m", _are_points)
_BITS = matching("[01]{1,256}", "a row of 0 and 1")
_TEXT = Values("a text", lambda _: True)

_PROJECTION = matching(
    r"[!.\-]|(?:\+(?:no_defs|south|(?:proj|zone|ellps|datum|units|lat_0|lat_1|lat_2|lat_ts|lon_0|k|k_0"
    r"|x_0|y_0|type|towgs84)=[A-Za-z0-9.,\-]{1,80})(?: |$))+",
    "a projection that names no file",
)

_LANE: Final = Allowed(
    {
        **{"id": _ID, "type": _TEXT},
        **dict.fromkeys(("allow", "disallow", "changeLeft", "changeRight"), _CLASSES),
        **dict.fromkeys(("acceleration", "customShape"), _SWITCH),
        **{"index": _COUNT, "speed": _SPEED, "length": _METRES, "shape": _SHAPE},
        **{"width": number(0, 1000), "endOffset": _METRES},
    }
)
_EDGE: Final = Allowed(
    {
        **dict.fromkeys(("id", "from", "to", "bidi"), _ID),
        **dict.fromkeys(("function", "spreadType"), _WORD),
        "crossingEdges": _IDS,
        **{"length": _METRES, "distance": _PLACE},
        **{"priority": number(-1000, 1000), "name": _TEXT, "shape": _SHAPE},
        "type": _TEXT,
    },
    {"lane": _LANE},
)
_JUNCTION: Final = Allowed(
    {
        "id": _ID,
        **dict.fromkeys(("type", "rightOfWay", "fringe", "roundabout"), _WORD),
        **dict.fromkeys(("x", "y", "z"), _PLACE),
        **dict.fromkeys(("incLanes", "intLanes"), _IDS),
        **dict.fromkeys(("customShape", "keepClear"), _SWITCH),
        **{"shape": _SHAPE, "radius": number(-1, 1e4), "name": _TEXT},
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


def _connection(**more: Values) -> Allowed:
    return Allowed({**_CONNECTION.attributes, **more})


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
            "checkLaneFoes.roundabout": _SWITCH,
            # Without the place of a schema: a reader that validates would fetch what stands there.
            "spreadType": _WORD,
        },
        {
            "location": Allowed(
                {
                    "netOffset": matching(f"{_EARTH_M},{_EARTH_M}", "x,y"),
                    "convBoundary": matching(f"(?:{_EARTH_M},){{3}}{_EARTH_M}", "four numbers"),
                    "origBoundary": matching(f"(?:{_EARTH_M},){{3}}{_EARTH_M}", "four numbers"),
                    "projParameter": _PROJECTION,
                },
                may_go=True,
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
            "connection": _connection(via=_ID),
        },
    )
}
"""A net that `hosting` made, with lanes inside of junctions."""

_OFFSET = matching("begin|-?[0-9]{1,9}(?:[.][0-9]{0,9})?", "a number of seconds, or begin")
_PHASE = Allowed(
    {
        **dict.fromkeys(("duration", "minDur", "maxDur"), number(0, 1e6)),
        "state": matching("[a-zA-Z]{1,4000}", "a row of letters"),
    }
)
ROAD_NET: Final = {
    "net": Allowed(
        NET["net"].attributes,
        {
            **NET["net"].children,
            "connection": _connection(via=_ID, tl=_ID, linkIndex=_COUNT),
            "roundabout": Allowed({"nodes": _IDS, "edges": _IDS}),
            "tlLogic": Allowed(
                {"id": _ID, "type": _WORD, "programID": _ID, "offset": _OFFSET},
                {"phase": _PHASE},
            ),
        },
    )
}
"""A net as netconvert writes it, with lanes inside of junctions, roundabouts and lights."""


def road_net(content: bytes, path: Path) -> etree._Element:
    """Return the allowed part of a net that a user names; raises as `received.parse`."""
    return parse(content, ROAD_NET, f"the net {path}", MAX_NET_ELEMENTS)


_WHO: Final = matching("|".join(VEHICLES), "one of " + ", ".join(VEHICLES))
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
"""The types of the vehicles; SUMO chooses what is not named."""

_LABEL = matching(
    r"(?:[A-Za-z0-9_ ,:+\-]|(?<=[0-9])\.(?=[0-9])|(?<=m)/(?=s)){0,250}",
    "a text of letters, digits and . , : + - _",
)
LABELS: Final = {
    "additional": Allowed(
        {},
        {
            "poi": Allowed(
                {
                    "id": _ID,
                    "color": _COLOUR,
                    "layer": number(-1000, 1000),
                    **dict.fromkeys(("x", "y"), _PLACE),
                    **dict.fromkeys(("width", "height"), number(0, 1000)),
                },
                {"param": Allowed({"key": _WORD, "value": _LABEL}, required=("key", "value"))},
                required=("id", "x", "y"),
            )
        },
    )
}
"""Texts beside the road."""

_MOTION: Final = {"id": _WHO, "x": _PLACE, "y": _PLACE, "pos": _METRES, "speed": _SPEED}
_RECORDED: Final = {
    **_MOTION,
    "angle": number(-360, 360),
    "type": _WHO,
    "lane": matching(
        "(?:main_in|main_out|ramp)_0"
        r"|(?::(?:M|gore|end|(?:main|ramp|out)[0-9]{1,4}-end)\.0_(?:main|ramp|out)[0-9]{1,4}"
        r"|(?:main|ramp|out)[0-9]{1,4}\.0)_0"
        r"|lane\.0_[01]",
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
"""SUMO's own record of a replay, of which only motion is compared."""
