"""The levels that a user names, in a text or as a list."""

from __future__ import annotations

from typing import Any

import pytest

import merge_sumo as ms
from merge_sumo.drivers.policies import policies_of
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import OWN, US23
from merge_sumo.simulation.povs import parse_levels

SHIPPED = policies_of(US23)


@pytest.mark.parametrize(
    ("asked", "own", "levels"),
    [
        (1, False, (1,)),
        ("0,1", False, (0, 1)),
        (" 2, 0 ", False, (0, 2)),
        ([1, "0", 1], False, (0, 1)),
        ("all", False, (0, 1, 2)),
        ("0,own", True, (0, OWN)),
    ],
)
def test_are_read_in_their_order(asked, own, levels):
    assert parse_levels(asked, SHIPPED, own=own) == levels


@pytest.mark.parametrize(
    ("asked", "own", "said"),
    [
        ("0,3", False, "unknown POV level '3': choose 0, 1, 2, all, or own"),
        ([], False, "unknown POV level ''"),
        ("0,all", False, "unknown POV level 'all'"),
        ("0,own", False, "unknown POV level own: choose 0, 1, 2, all, or own with `pov`"),
        ("1,0", True, "`pov` drives at `level` own or all, not at `level` 1,0"),
    ],
)
def test_of_no_pov_are_refused(asked: Any, own, said):
    with pytest.raises(UserError, match=said):
        parse_levels(asked, SHIPPED, own=own)


def test_two_are_tested_and_run_again(tmp_path):
    run = ms.campaign("design1", level="0,1", cases=20, seed=1, out=tmp_path / "run")
    assert {outcome.case.level for outcome in run.recorded.outcomes} == {0, 1}
    again = ms.rerun(run, level=[0, 1]).to_record()
    assert sum(row["cases"] for row in again["steps"][0]["transitions"]) == 20
    with pytest.raises(UserError, match="has no cases at level '2': it has 0, 1, or all"):
        ms.rerun(run, level="0,2")
    with pytest.raises(UserError, match="`level` 0,1 is not possible here: choose one level"):
        ms.run("design1", level="0,1", x_pov0_m=-200.0, v_pov0_mps=30.0)
