"""What a record may hold is declared, and anything else is one sentence that names the field."""

from __future__ import annotations

import json
import math
from contextlib import suppress
from dataclasses import dataclass
from enum import StrEnum
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec import Meta

from merge_sumo.errors import UserError
from merge_sumo.records import Record, check_fields, convert, decode, read_indexed


class Colour(StrEnum):
    RED = "red"
    BLUE = "blue"


@dataclass(frozen=True)
class Car:
    index: int
    speed_mps: float = 1.0
    colour: Colour = Colour.RED
    share: Annotated[float, Meta(ge=0.0, le=1.0)] | None = None
    range_m: tuple[float, float] | float = 0.0
    edges: tuple[str, ...] = ()
    side: Literal["left", "right"] = "left"

    def __post_init__(self) -> None:
        check_fields(self)


class Round(Record, frozen=True, tag_field="kind", tag="round"):
    radius_m: Annotated[float, Meta(gt=0.0)]


class Square(Record, frozen=True, tag_field="kind", tag="square"):
    width_m: float


WRONG = [
    ({"index": True}, "index is True: it must be a whole number"),
    ({"speed_mps": "1"}, "speed_mps is '1': it must be a number"),
    ({"speed_mps": 10**400}, "it must be finite"),
    ({"colour": "green"}, "colour is 'green': it must be one of red, blue"),
    ({"share": 2}, "share is 2: it must be a number of 0 or more, up to 1"),
    ({"range_m": [1, 2, 3]}, "two numbers, [low, high] or a number"),
    ({"edges": "a b"}, "edges is 'a b': it must be a list of texts"),
    ({"side": "up"}, "side is 'up': it must be one of left, right"),
    ({"spede_mps": 1}, "car has no 'spede_mps': it has index, speed_mps"),
]


@pytest.mark.parametrize(("change", "says"), WRONG, ids=str)
def test_another_value_is_refused_with_its_field(change, says):
    with pytest.raises(UserError) as error:
        convert({"index": 0, **change}, Car)
    assert says in str(error.value)


def test_a_field_that_is_missing_is_named():
    with pytest.raises(UserError, match="it has no field index"):
        convert({}, Car)


def test_a_whole_number_is_a_number_and_a_list_is_a_tuple():
    car = Car(np.int64(3), 18, range_m=[1, 2])  # type: ignore[arg-type]
    assert car == convert({"index": 3, "speed_mps": 18, "range_m": [1, 2]}, Car)
    assert (type(car.index), type(car.speed_mps), car.range_m) == (int, float, (1.0, 2.0))


@given(st.floats(allow_nan=False, allow_infinity=False))
def test_a_number_keeps_its_last_bit(number):
    found = decode(json.dumps(number))
    assert found == number
    assert math.copysign(1.0, found) == math.copysign(1.0, number)


any_json: st.SearchStrategy[Any] = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner),
    max_leaves=6,
)


@given(record=any_json | st.fixed_dictionaries({"index": any_json, "colour": any_json}))
def test_any_value_is_a_record_or_a_sentence(record):
    for kind in (Car, Round | Square, dict[str, float]):
        with suppress(UserError):
            convert(record, kind)  # type: ignore[arg-type]


def test_lines_are_read_by_their_index(tmp_path):
    path = tmp_path / "cars.jsonl"
    assert read_indexed(path, Car, range(3)) == []
    path.write_text('{"index": 2}\n{"index": 0, "colour": "blue"}\n')
    assert read_indexed(path, Car, range(3)) == [Car(2), Car(0, colour=Colour.BLUE)]
    for line in ('{"index": 2}', '{"index": 3}', "{", '{"index": 1, "more": 1}'):
        path.write_text('{"index": 2}\n' + line)
        with pytest.raises(UserError, match=r"line 2 of .*cars\.jsonl"):
            read_indexed(path, Car, range(3))
