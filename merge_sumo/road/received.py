"""XML from another person: read as data, reduced to the allowed elements and attributes.

SUMO's files can name other files, devices and addresses, and SUMO reads and writes all of them.
So no file that came from outside reaches SUMO or netconvert. It is read here, without opening what
is no plain file, without entities and within limits, and what goes on is a tree of the elements
and attributes that `allowed.py` lists. What is not listed is dropped, since the scenario needs none
of it; a value that is not what its attribute holds is refused, since dropping it would change the
road or the record. A net that a user names is read in the same way by every command.
"""

from __future__ import annotations

import gzip
import io
import os
import re
import stat
import zlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from lxml import etree

from merge_sumo.errors import UserError

MAX_BYTES: Final = 4 * 2**20
MAX_NET_BYTES: Final = 2**28
"""Of a net that a user names, unpacked: that of a city has 50 MB."""
MAX_ELEMENTS: Final = 5_000
"""Of a file of a replay folder: a corridor has some twenty and a record less than a thousand."""
MAX_NET_ELEMENTS: Final = 4_000_000
"""Of a net that a user names: that of a city has 500,000."""
GZIP: Final = b"\x1f\x8b"
"""How packed files begin."""
MAX_CHARS: Final = 2**20
"""Of the value of an attribute."""
MAX_NUMBER_CHARS: Final = 64

_NUMBER: Final = re.compile(r"[+-]?(?:\d+(?:\.\d*)?|\.\d+)(?:[eE][+-]?\d{1,3})?", re.ASCII)


@dataclass(frozen=True, slots=True)
class Values:
    """The values of an attribute: a test, and the words for it in a sentence."""

    words: str
    include: Callable[[str], bool]


@dataclass(frozen=True, slots=True)
class Allowed:
    """The attributes and children of an element, and the names of those that are `required`.

    One that `may_go` is dropped where a value of it is wrong, since nothing depends on it.
    """

    attributes: Mapping[str, Values] = field(default_factory=dict)
    children: Mapping[str, Allowed] = field(default_factory=dict)
    required: tuple[str, ...] = ()
    may_go: bool = False


def number(low: float, high: float) -> Values:
    """Return the finite numbers from `low` to `high`."""
    return Values(f"a number from {low:g} to {high:g}", lambda text: is_number(text, low, high))


def matching(pattern: str, words: str) -> Values:
    """Return the texts that match a pattern as a whole.

    No two of its repetitions may compete for the same characters: that would take for ever.
    """
    compiled = re.compile(pattern)
    return Values(words, lambda text: compiled.fullmatch(text) is not None)


def is_number(text: str, low: float, high: float) -> bool:
    """Return whether a text is a finite number from `low` to `high`."""
    short = len(text) <= MAX_NUMBER_CHARS and _NUMBER.fullmatch(text) is not None
    return short and low <= float(text) <= high


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


def read_net(path: Path) -> bytes:
    """Return the bytes of a net that a user names, unpacked where it is packed by gzip.

    Every command and kind of controller reads nets here, so all take the same ones. Raises
    `UserError` for what is no plain file, cannot be unpacked, or is larger than `MAX_NET_BYTES`.
    """
    content = read_bytes(path, "the net", follow_links=True, limit=MAX_NET_BYTES)
    if not content.startswith(GZIP):
        return content
    try:
        with gzip.open(io.BytesIO(content)) as packed:
            content = packed.read(MAX_NET_BYTES + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise UserError(f"cannot unpack the net {path} ({error}): copy or pack it again") from error
    if len(content) > MAX_NET_BYTES:
        size = f"{MAX_NET_BYTES // 2**20} MiB"
        raise UserError(f"cannot read the net {path}: unpacked it is larger than {size}")
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
    content: bytes, allowed: Mapping[str, Allowed], name: str, max_elements: int = MAX_ELEMENTS
) -> etree._Element:
    """Return the allowed part of an XML file as a tree.

    Raises `UserError` when it is no UTF-8, is no XML, declares a document type, has more elements
    than `max_elements`, or has a value that its attribute does not take; `name` is what the
    sentence calls it.
    """
    check_text(content, name)
    parser = etree.XMLParser(
        target=_Cleaner(allowed, name, max_elements),  # type: ignore[arg-type] # the stubs know parsers of bytes, too
        # Whatever the file declares: another encoding could hide what is looked for above.
        encoding="utf-8",
        resolve_entities=False,
        no_network=True,
        load_dtd=False,
        huge_tree=False,
    )
    try:
        return etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        reason = str(error.msg).encode("ascii", "backslashreplace").decode()
        raise UserError(f"{name} is not readable XML: {reason:.200}") from error


def cleaned(
    content: bytes, allowed: Mapping[str, Allowed], name: str, max_elements: int = MAX_ELEMENTS
) -> bytes:
    """Return the allowed part of an XML file as a file; raises as `parse`."""
    return serialize(parse(content, allowed, name, max_elements))


def serialize(root: etree._Element) -> bytes:
    """Return a tree as an XML file."""
    etree.indent(root, space="    ")
    return etree.tostring(root, xml_declaration=True, encoding="UTF-8")


class OtherRootError(UserError):
    """For a file of another kind; `tag` is the root that it has."""

    def __init__(self, name: str, expected: str, tag: str) -> None:
        """Say it of a file by its name."""
        super().__init__(f"{name} has another root than <{expected}>")
        self.tag = tag


class _Cleaner:
    """Builds the allowed tree while the parser reads, and holds nothing else."""

    def __init__(self, allowed: Mapping[str, Allowed], name: str, max_elements: int) -> None:
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
                raise OtherRootError(self._name, next(iter(expected)), tag)
            self._dropped += 1
            return
        allowed = expected[tag]
        kept = {name: text for name, text in attributes.items() if name in allowed.attributes}
        for name, text in kept.items():
            values = allowed.attributes[name]
            if not (len(text) <= MAX_CHARS and values.include(text)):
                if allowed.may_go:
                    self._dropped += 1
                    return
                which = f"{tag} {attributes.get('id', ''):.40}".rstrip()
                raise UserError(
                    f"{self._name} has an element {which} whose {name} is not {values.words}"
                )
        for name in allowed.required:
            if name not in kept:
                raise UserError(f"{self._name} has an element {tag} without {name}")
        if parent is None:
            element = self._root = etree.Element(tag, kept)
        else:
            element = etree.SubElement(parent, tag, kept)
        self._open.append((element, allowed.children))

    def end(self, tag: str) -> None:
        if self._dropped:
            self._dropped -= 1
        else:
            self._open.pop()

    def close(self) -> etree._Element | None:
        return self._root
