"""Every command that runs cases judges a case as every other one does, in traffic.

The reference is `run RUN INDEX`, which runs one case alone. The criterion has a follow-up, so that
a command that forgets the scenario or its follow-up cannot pass.
"""

# mypy: no-strict-optional

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import merge_sumo as ms
from merge_sumo.campaigns.recorded import OUTCOMES
from merge_sumo.metrics.criterion import Criterion
from merge_sumo.metrics.fmc import fmc
from merge_sumo.scenario.case import Case, Pool
from merge_sumo.scenario.scenario import Scenario

CRITERION = "after_gap_m < 12 or ttc_s < 3"


VUT, LEVEL = "design2", 0
"""It fails in some cases of the scenario and not in others."""
ASKED = (
    *("--vut", VUT, "--level", LEVEL, "--scenario", "us23-traffic"),
    *("--fail-when", CRITERION, "--follow-up", 3),
)
"""The options that each command takes."""
CASES = 12
OF_A_CASE = (
    *("x_pov0_m", "v_pov0_mps", "svo_rad", "headway_ahead_s", "headway_behind_s", "sense_delay_s"),
)


class SumoSimulation:
    """The command line in a folder of its own, with a campaign in it."""

    def __init__(self, main: Any) -> None:
        self._main = main
        self.campaign = self("campaign", *ASKED, *self.search(CASES), "--out", "run")[0]

    def __call__(self, *arguments: object, codes: tuple[int, ...] = (0,)) -> Any:
        """Return the objects that a command prints as lines of JSON."""
        code, out, err = self._main(*arguments, "--json")
        assert code in codes, err
        return [json.loads(line) for line in out.splitlines() if line.startswith("{")]

    @staticmethod
    def search(cases: int) -> tuple[object, ...]:
        return "--sampler", "uniform", "--cases", cases, "--seed", 0

    @property
    def records(self) -> list[dict[str, Any]]:
        return lines_of(Path("run") / OUTCOMES)

    @property
    def scenario(self) -> Scenario:
        return ms.open_run("run").recorded.scenario

    def fails_alone(self, case: Case) -> bool:
        """Return whether a case fails when it is run alone."""
        at = {name: x for name in OF_A_CASE if (x := getattr(case, name)) is not None}
        found = ms.run(VUT, level=LEVEL, scenario=self.scenario, at=at)
        return Criterion(CRITERION).outcome(found.trajectory).failed


def lines_of(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()]


def fails(record: dict[str, Any]) -> bool:
    return record["margin"] < 0.0


@pytest.fixture
def simulation(monkeypatch, tmp_path, command_line) -> SumoSimulation:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "cache"))
    return SumoSimulation(command_line)


@pytest.mark.slow
def test_every_command_judges_a_case_alike(simulation: SumoSimulation):
    records = simulation.records
    assert 0 < sum(map(fails, records)) < CASES, "else nothing is told apart"
    assert simulation.campaign["levels"][str(LEVEL)]["failures"] == sum(map(fails, records))
    run_judges_as_the_campaign(simulation, records)
    rerun_changes_nothing(simulation)
    truth_judges_as_run(simulation)
    probability_judges_as_run(simulation)
    resume_goes_on_alike(simulation, records)


def run_judges_as_the_campaign(simulation: SumoSimulation, records: list[dict[str, Any]]) -> None:
    told = [next(r for r in records if fails(r) is failing) for failing in (True, False)]
    for record in told:
        (again,) = simulation("run", "--case", "run", record["index"], codes=(0, 1))
        for name in ("motion", "index", "batch", "foretold"):
            again.pop(name, None)
        assert again == {k: v for k, v in record.items() if k in again}
        assert again["margin"] == record["margin"]


def rerun_changes_nothing(simulation: SumoSimulation) -> None:
    (again,) = simulation("rerun", "run")
    (step,) = again["steps"]
    assert sum(row["cases"] for row in step["transitions"]) == CASES
    assert {case["change"] for case in step["cases"]} <= {"pass with neither"}
    assert again["worse"] is False


def truth_judges_as_run(simulation: SumoSimulation) -> None:
    (found,) = simulation("truth", *ASKED, "--cases", 10, "--workers", 1)
    (truth,) = found["levels"]
    dims = len(simulation.scenario.dimensions(LEVEL))
    points = np.random.default_rng([0, LEVEL]).random((10, dims))
    cases = Pool(levels=(LEVEL,), scenario=simulation.scenario).cases(points, LEVEL)
    failing = np.array([simulation.fails_alone(case) for case in cases])
    assert (truth["failures"], truth["fmc"]) == (failing.sum(), fmc(points[failing]))


def probability_judges_as_run(simulation: SumoSimulation) -> None:
    (found,) = simulation("probability", "run", "--cases", 60)
    assert found["missed"], "else nothing is told apart"
    for given in found["missed"][:3]:
        fixed = {"v_vut0_mps": simulation.scenario.bounds("v_vut0_mps")[0]}
        assert simulation.fails_alone(Case(scenario=simulation.scenario, **{**fixed, **given}))


def resume_goes_on_alike(simulation: SumoSimulation, records: list[dict[str, Any]]) -> None:
    simulation("campaign", "--resume", "run", "--cases", CASES + 6)
    assert simulation.records[:CASES] == records
    assert len(simulation.records) == CASES + 6
