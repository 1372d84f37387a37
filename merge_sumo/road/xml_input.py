"""Read XML files of others as data: without entities and document types, and within limits.

SUMO reads and writes the files, devices and addresses that its input files name. It therefore gets
no received file, but files that merge-sumo writes from the data read here (`harmless_net`).
"""

from __future__ import annotations

import gzip
import io
import re
import zlib
from pathlib import Path

from lxml import etree

from merge_sumo.errors import UserError
from merge_sumo.files import read_limited

MAX_BYTES = 2**28
"""Maximum size of a file, unpacked. The net of a city has 50 MB."""
MAX_ELEMENTS = 4_000_000
"""Maximum number of elements of a file. The net of a city has 500,000."""
GZIP = b"\x1f\x8b"
"""First bytes of a gzip file."""
NET_TAGS = frozenset(
    (
        "net",
        "location",
        "edge",
        "lane",
        "junction",
        "request",
        "connection",
        "roundabout",
        "tlLogic",
        "phase",
    )
)
"""Elements of a net that describe the road. Only a location can name a file, in its projection."""
RECORD_TAGS = frozenset(("fcd-export", "timestep", "vehicle"))
"""Elements of floating car data."""
PROJECTION = re.compile(
    r"""
    [!.-]                    # none, UTM or simple: SUMO's short forms
    | ( \+                   # or parameters of PROJ, such as "+proj=utm +zone=32"
        ( no_defs | south
        | (proj|zone|ellps|datum|units|lat_0|lat_1|lat_2|lat_ts|lon_0|k|k_0|x_0|y_0|type|towgs84)
          =[\w.,-]{1,80}     # no "/": no file
        ) ([ ]|$)
      )+
    """,
    re.ASCII | re.VERBOSE,
)
"""Projections that do not name a file."""
NO_PROJECTION = "!"
"""SUMO's word for coordinates without a projection."""


def read_xml(path: Path, what: str) -> bytes:
    """Return the bytes of an XML file.

    Args:
        path: the file, plain or packed by gzip.
        what: its description in messages, such as "the net".

    Returns:
        The unpacked content.

    Raises:
        UserError: it is not a regular file, cannot be unpacked, or is larger than `MAX_BYTES`.
    """
    try:
        content = read_limited(path, MAX_BYTES)
        if content.startswith(GZIP):
            with gzip.open(io.BytesIO(content)) as packed:
                # One byte more than allowed, which tells that there is more.
                content = packed.read(MAX_BYTES + 1)
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise UserError(f"cannot unpack {what} {path} ({error}): copy or pack it again") from error
    except OSError as error:
        raise UserError(f"cannot read {what} {path}: {error.strerror}") from error
    if len(content) > MAX_BYTES:
        size = f"{MAX_BYTES // 2**20} MiB"
        raise UserError(f"cannot read {what} {path}: unpacked it is larger than {size}")
    return content


def parse_xml(content: bytes, what: str, tags: frozenset[str]) -> etree._Element:
    """Parse an XML file and keep the elements with some tags.

    Args:
        content: the unpacked content of the file.
        what: its description in messages, such as "the net a.net.xml".
        tags: the tags to keep. The root is always kept.

    Returns:
        The root of the tree.

    Raises:
        UserError: the content is not UTF-8 or not XML, or it has an entity, a document type, or
            more elements than `MAX_ELEMENTS`.

    Example:
        >>> root = parse_xml(b'<net><edge id="a"/><param key="b"/></net>', "my net", NET_TAGS)
        >>> [element.tag for element in root]
        ['edge']
    """
    try:
        content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise UserError(f"{what} is not readable XML: save it as UTF-8") from error
    if b"<!DOCTYPE" in content or b"<!ENTITY" in content:
        raise UserError(f"{what} declares a document type or an entity: remove the declaration")
    elements = etree.iterparse(
        io.BytesIO(content),
        # Another encoding, which the file may declare, could hide an entity from the check above.
        encoding="utf-8",
        remove_comments=True,
        remove_pis=True,
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
    )
    try:
        for number, (_, element) in enumerate(elements, start=1):
            if number > MAX_ELEMENTS:
                raise UserError(f"{what} has more than {MAX_ELEMENTS} elements")
            if element.tag not in tags:
                element.clear()  # at once, to save memory; it is removed below
    except etree.XMLSyntaxError as error:
        reason = str(error.msg).encode("ascii", "backslashreplace").decode()
        raise UserError(f"{what} is not readable XML: {reason:.200}") from error
    root: etree._Element = elements.root
    unwanted = {element.tag for element in root.iter()} - tags
    etree.strip_elements(root, *unwanted, with_tail=False)
    return root


def harmless_net(path: Path) -> etree._Element:
    """Return the road of a net file, without names of files or addresses.

    Args:
        path: the net file.

    Returns:
        The root of the net.

    Raises:
        UserError: it cannot be read, or is not a net, as in `read_xml` and `parse_xml`.
    """
    root = parse_xml(read_xml(path, "the net"), f"the net {path}", NET_TAGS)
    for name in map(str, root.keys()):
        if name.startswith("{"):
            del root.attrib[name]  # the address of a schema
    for location in root.iterfind("location"):
        if not PROJECTION.fullmatch(location.get("projParameter", NO_PROJECTION)):
            location.set("projParameter", NO_PROJECTION)
    return root


def to_bytes(root: etree._Element) -> bytes:
    """Return a tree as the content of an XML file.

    Args:
        root: the root of the tree, which gets indented.
    """
    etree.indent(root, space="    ")
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")
