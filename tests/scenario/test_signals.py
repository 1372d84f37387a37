"""Signals of a controller: bounded, kept with the motion, shown and exported."""

# mypy: no-strict-optional

from __future__ import annotations

import csv
import json

import numpy as np
import pytest

import merge_sumo as ms
from merge_sumo.errors import UserError
from merge_sumo.records import decode
from merge_sumo.scenario.scenario import POV, VUT
from merge_sumo.scenario.signals import (
    CHARACTERS,
    MOST_NAMES,
    SignalRuns,
    Signals,
    from_runs,
    to_runs,
    valid_signals,
)

LEAVES = """
class Vut:
    def reset(self, seen):
        self.yields = False
    def act(self, seen):
        gap_m = seen.x_pov_m - seen.x_vut_m
        self.yields = self.yields or (seen.x_vut_m > -60.0 and abs(gap_m) < 15.0)
        self.signals = {"mode": "yield" if self.yields else "go", "gap_m": gap_m}
        return -2.0 if self.yields and seen.v_vut_mps > 10.0 else 1.0
"""


@pytest.mark.slow
def test_every_step_has_what_was_left_at_it(write_vut, tmp_path):
    run = ms.campaign(write_vut(LEAVES), level=0, cases=40, sampler="uniform", out=tmp_path / "run")
    for outcome in run.recorded.outcomes:
        found = run.recorded.trajectory(outcome.index)
        x_pov_m, x_vut_m = found.whole[:, POV, 0], found.whole[:, VUT, 0]
        gap_m = x_pov_m - x_vut_m
        left = found.signals["gap_m"]
        assert left[-1] is None, "the last row has no action"
        assert left[:-1] == pytest.approx(gap_m[:-1], rel=1e-5)
        yields = np.array(found.signals["mode"][:-1]) == "yield"
        begins = (x_vut_m[:-1] > -60.0) & (np.abs(gap_m[:-1]) < 15.0)
        assert np.array_equal(yields, np.maximum.accumulate(begins))


HOSTILE = """
class Word(str):
    def __str__(self): raise ValueError
    def __getitem__(self, _): raise ValueError
class Vut:
    def act(self, seen):
        self.signals = {
            "=cmd()": "=1+1", "</script><b>": "\\x1b[2J\\u202e</script>",
            Word("w" * 99): Word("v" * 99),
            "big": 10 ** 400, "nan": float("nan"), "\\ud800": "\\udfff", "flag": True, "list": [1],
            "more": 1.0, "and more": 2.0,
        }
        return 1.0
"""


def test_hostile_names_and_words_are_cut_without_harm(write_vut, tmp_path):
    run = ms.campaign(write_vut(HOSTILE), level=0, cases=4, sampler="uniform", out=tmp_path / "run")
    assert not any(outcome.measures.end.is_error for outcome in run.recorded.outcomes)
    left = run.recorded.trajectory(0).signals
    assert {name: values[0] for name, values in left.items()} == {
        "=cmd()": "=1+1",
        "</script><b>": "\\x1b[2J\\u202e</script>",
        "w" * CHARACTERS: "v" * CHARACTERS,
        "\\ud800": "\\udfff",
        "flag": "true",
    }
    assert "</script><b>" not in run.report().read_text()
    (table,) = ms.export(run, [0], file_format="csv", out=tmp_path / "csv")
    with table.open(encoding="utf-8") as file:
        head, first, *_ = csv.reader(file)
    assert head[-5] == "signal_=cmd()"
    assert first[-5] == "'=1+1"


@pytest.mark.parametrize(
    "left", [None, 3, [1], "mode", {1: 2.0}, {"x": None}, {"x": float("inf")}, {}, {"x": [1.0]}]
)
def test_what_is_no_number_and_no_word_is_dropped(left):
    assert valid_signals(left) == {}


@pytest.mark.parametrize(
    "record",
    [
        {},
        None,
        {"x": [[10**12, 1.0]]},
        {"x": [[3, 1.0]]},
        {"x": [[-1, 1.0], [6, 1.0]]},
        {"x": [[5, "\x1b"]]},
        {"x": [[5, "w" * 99]]},
        {"x": [[5, True]]},
        {"x": [[5, [1]]]},
        {"x\n": [[5, 1.0]]},
        {"x": [[True, 1.0]]},
        {"x": 5},
        {f"{n}": [[5, 1.0]] for n in range(MOST_NAMES + 1)},
    ],
)
def test_a_file_of_a_stranger_is_refused(record):
    with pytest.raises(UserError):
        from_runs(decode(json.dumps(record), SignalRuns), 5)


def test_what_is_kept_is_read_as_it_was():
    signals: Signals = {"mode": ("go", "go", None), "gap_m": (1.5, -2.0, None)}
    assert from_runs(decode(json.dumps(to_runs(signals)), SignalRuns), 3) == signals
