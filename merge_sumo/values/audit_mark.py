"""What marks an outcome as an audit case."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from merge_sumo.system.records import Record


class AuditMark(Record, frozen=True):
    """The mark of an audit case, with what was known of its place before it ran.

    Attributes:
        nearest_failure: distance in the unit cube to the nearest failure that earlier batches had
            found at its level; None where they had found none.
    """

    nearest_failure: Annotated[float, Meta(ge=0.0)] | None = None
