"""Repair: values of parameters that are known in closed form, and controllers beyond repair."""

# mypy: no-strict-optional

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest

from merge_sumo import api
from merge_sumo.errors import UserError
from merge_sumo.studies import repair as mending
from merge_sumo.studies.repair import BISECTIONS, RESERVE
from merge_sumo.vuts.factory import VutFactory
from merge_sumo.vuts.parameters import Range
from merge_sumo.vuts.spec import parse

pytest.importorskip("optuna")

SOURCE = """
class Base:
    def __init__(self):
        self.first_x_m = None

    def reset(self, seen):
        self.first_x_m = seen.x_pov_m

    def act(self, seen):
        return -self.braking_mps2() if seen.t_s < 0.05 else 1.0


class Brakes(Base):
    '''Brakes once by so much, whatever it sees.'''

    def __init__(self, brake=3.0, unused=1.0):
        self.brake, self.unused = brake, unused

    def braking_mps2(self):
        return self.brake


class Edge(Base):
    '''Brakes by 3 m/s2 where the POV starts before an edge.'''

    edge_m = -220.0

    def braking_mps2(self):
        return 3.0 if self.first_x_m < self.edge_m else 0.0


class Sides(Base):
    '''Brakes on one side of -260 m, whatever the value: the other side then passes.'''

    def __init__(self, side=1.0):
        self.side = side

    def braking_mps2(self):
        return 3.0 if (self.first_x_m + 260.0) * self.side > 0.0 else 0.0
"""
CRITERION = "vut_max_brake_mps2 > 2"
HERE: dict[str, Any] = {"workers": 1, "progress": False}
FEW: dict[str, Any] = {"trials": 8, "rounds": 1, **HERE}


@pytest.fixture(scope="module")
def campaigns(tmp_path_factory):
    """Return a function that gives the campaign of a class, which ran once."""
    folder = tmp_path_factory.mktemp("repair")
    (folder / "vut.py").write_text(SOURCE, encoding="utf-8")
    known: dict[str, Path] = {}

    def campaign(name: str) -> Path:
        if name not in known:
            run = api.campaign(
                f"{folder / 'vut.py'}:{name}",
                level=0,
                cases=20,
                sampler="uniform",
                fail_when=CRITERION,
                out=folder / name,
                **HERE,
            )
            known[name] = run.folder
        return known[name]

    return campaign


def repair(run, params, **given):
    """Repair the controller of a campaign, which is named again as it was."""
    folder = getattr(run, "folder", run)
    return api.repair(run, params, **{"vut": api.open_run(folder).settings["vut"], **given})


def test_a_threshold_that_is_known_is_found_with_its_reserve(campaigns, tmp_path):
    # It fails where it brakes by more than 2 m/s2: the least change of 3 is to 2.
    run = campaigns("Brakes")
    result = repair(run, ["brake=0..4"], out=tmp_path / "out", **FEW)
    found = result
    assert found.failing == tuple(range(20))
    assert found.stays == ()
    assert result.verified
    chosen = found.chosen.values["brake"]
    # After the bisections the boundary is known to 1/16 of the way to the first value found, which
    # is 3 at most; the reserve goes on by a quarter of the change.
    error = 3.0 / 2**BISECTIONS
    assert 2.0 - RESERVE * (1.0 + error) - error <= chosen <= 2.0
    assert found.repaired == f"{run.parent / 'vut.py'}:Brakes?brake={chosen:g}"
    # The case brakes by `chosen` for one step instead of by 3.
    assert found.chosen.extra["braking"] == pytest.approx(chosen - 3.0)
    record = json.loads((tmp_path / "out/repair.json").read_text())
    assert record["repaired"] == found.repaired
    assert record["rounds"][0]["fmc"] == 0.0
    page = (tmp_path / "out/repair.html").read_text()
    assert f"Brakes?brake={chosen:g}" in page
    assert "default-src 'none'" in page
    assert (tmp_path / "out/changes.html").exists()
    # The fresh campaign is one like any other: another seed, and the spec as its record.
    fresh = api.open_run(tmp_path / "out/campaign-1")
    assert fresh.settings["seed"] == 1
    assert fresh.settings["vut"] == found.repaired


def test_only_the_cases_decide_on_an_attribute(campaigns, tmp_path):
    run = api.open_run(campaigns("Edge"))
    starts_m = [row["x_pov0_m"] for row in run.cases]
    failing = tuple(i for i, x_m in enumerate(starts_m) if x_m < -220.0)
    result = repair(run.folder, ["edge_m=-345..-200"], out=tmp_path / "out", **FEW)
    assert result.failing == failing
    assert result.stays == ()
    assert result.chosen.values["edge_m"] <= min(starts_m)


def test_a_failure_that_moves_is_no_repair(campaigns, tmp_path):
    run = campaigns("Sides")
    result = repair(run, ["side=-1..1"], out=tmp_path / "out", **FEW)
    assert result.chosen is None
    assert result.stays == result.failing
    assert not result.verified
    assert any(trial.broke and not trial.fails for trial in result.trials)
    assert "these stay" in str(result)
    assert not (tmp_path / "out/campaign-1").exists()
    assert "No values in these ranges" in (tmp_path / "out/repair.html").read_text()


@pytest.mark.parametrize(
    ("params", "said"),
    [
        ([], "name what may change: `params` NAME=LOW..HIGH"),
        (["brake"], "`params` brake: write NAME=LOW..HIGH"),
        (["brake=4..1"], "the range is empty: give the lower end first"),
        (["brake=0..2"], "it is 3 today, which is not in that range"),
        (["brake=0..4", "brake=1..4"], "`params` brake is given twice"),
        (["brak=0..4"], "no such parameter: did you mean brake?"),
        (["unused=0..4"], "`params` unused has no effect on any case, be it 0 or 4"),
    ],
)
def test_what_cannot_be_searched_for_is_refused_in_a_sentence(campaigns, tmp_path, params, said):
    with pytest.raises(UserError) as refused:
        repair(campaigns("Brakes"), params, out=tmp_path / "out", **FEW)
    assert said in str(refused.value)


def test_too_few_trials_and_other_costs_are_refused(campaigns, tmp_path):
    run, given = campaigns("Brakes"), {"out": tmp_path / "out", **FEW}
    with pytest.raises(UserError, match="`trials` is 2: it must be 3 or more"):
        repair(run, ["brake=0..4"], **{**given, "trials": 2})
    with pytest.raises(UserError, match="`cost` is 'money': choose time or braking"):
        repair(run, ["brake=0..4"], cost="money", **given)
    with pytest.raises(UserError, match="the parameters of a network are its weights"):
        VutFactory(parse("onnx:policy.onnx"), files={}).values_of((Range("gain", 0.0, 1.0),))
    assert not (tmp_path / "out").exists()


def test_without_failures_and_without_optuna_it_says_so(campaigns, tmp_path, monkeypatch):
    vut = f"{campaigns('Brakes').parent / 'vut.py'}:Brakes?brake=1"
    with pytest.raises(UserError, match=r"every case passes with .*: nothing is to be repaired"):
        repair(campaigns("Brakes"), ["brake=0..4"], vut=vut, out=tmp_path / "out", **FEW)
    assert not (tmp_path / "out").exists()
    monkeypatch.setattr(mending, "find_spec", lambda _: None)
    with pytest.raises(UserError, match=r"needs optuna: run `pip install 'merge-sumo\[repair\]'`"):
        repair(campaigns("Brakes"), ["brake=0..4"], out=tmp_path / "out", **FEW)
