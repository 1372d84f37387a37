"""A POV of the user: any kind of VUT, at level own."""

# mypy: no-strict-optional

from __future__ import annotations

from dataclasses import replace
from itertools import chain
from pathlib import Path

import numpy as np
import pytest
from support.calling import assert_refused
from support.misbehaviours import CATALOGUE, DEADLINE_S, GUILTY_MPS
from support.plans import plan_for
from support.processes import none_left
from support.vut_contract import cases_of, factory, same

from merge_sumo.controllers.spec import ControllerOptions
from merge_sumo.drivers.policies import policies_of
from merge_sumo.metrics.measures import Measures
from merge_sumo.scenario.case import Case, from_unit
from merge_sumo.scenario.scenario import LEVELS, OWN, US23
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.simulation.povs import Povs, own_pov
from merge_sumo.simulation.simulator import Simulator

KEEPS = "def Pov(seen):\n    return 0.0\n"
YIELDS = """
class Pov:
    def act(self, seen):
        gap_m = seen.x_pov_m - seen.x_vut_m
        return -1.0 if abs(gap_m) < 40.0 and seen.x_vut_m < 0.0 else 0.3
"""


@pytest.fixture(autouse=True)
def of_a_user(tmp_path, monkeypatch):
    """Work as a user with a cache and a folder of their own."""
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "mine"))
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")


def pov(source: str, name: str = "my_pov.py") -> str:
    """Write a POV and return its spec."""
    Path(name).write_text(source)
    return f"{name}:Pov"


def own(cases: list[Case]) -> list[Case]:
    return [replace(case, level=OWN, svo_rad=None) for case in cases]


def run(
    spec: str | None,
    cases: list[Case],
    vut: str = "design2",
    corridors: int = 4,
    *,
    hosted: bool = False,
    **options,
) -> list[Trajectory]:
    """Return the trajectories of cases against a POV of the user."""
    options["in_process"] = not hosted
    povs = Povs(
        policies=policies_of(US23),
        own=None if spec is None else own_pov(spec, ControllerOptions(**options)),
    )
    scenario = cases[0].scenario
    with Simulator(
        plan_for(
            factory(vut, in_process=not hosted), scenario=scenario, povs=povs, corridors=corridors
        )
    ) as ground:
        return ground.run(cases)


class TestAPov:
    def test_that_keeps_its_speed_drives_as_level_0_to_the_last_bit(self):
        cases = cases_of(20)
        assert same(run(pov(KEEPS), own(cases)), run(None, cases))

    @pytest.mark.parametrize("spec", ["my_pov.py:Pov", "sumo:IDM"])
    def test_changes_nothing_at_the_other_levels(self, spec):
        pov(YIELDS)
        rng = np.random.default_rng(3)
        points = rng.random((12, 3))
        others = [
            from_unit(points[:, : 2 + (level == 2)], level, scenario=US23) for level in LEVELS
        ]
        cases = list(chain(*zip(*others, own(others[0]), strict=True)))
        mixed = run(spec, cases, vut="sumo:IDM", corridors=5)
        learned = [case for case in cases if case.level != OWN]
        kept = [motion for motion in mixed if motion.case.level != OWN]
        assert same(kept, run(None, learned, vut="sumo:IDM", corridors=5))
        alone = run(spec, [case for case in cases if case.level == OWN], vut="sumo:IDM")
        assert same([motion for motion in mixed if motion.case.level == OWN], alone)

    def test_is_asked_only_while_it_drives(self):
        source = """
class Pov:
    def __init__(self, corridors):
        pass
    def act_batch(self, seen):
        if not seen.active.any():
            open("idle", "w")
        return 0.0 * seen.t_s
"""
        cases = cases_of(2)  # the first one ends last
        run(pov(source), [cases[0], *own(cases[1:])])
        assert not Path("idle").exists()


CASES = own([case for k, case in enumerate(cases_of(6)) if k != 4])


class TestErrors:
    @pytest.mark.slow
    def test_of_the_pov_are_not_those_of_the_vut(self):
        how = CATALOGUE["batched: dies"]
        # Guilty is, as there, the case with the fastest POV: now that is itself.
        source = how.source.replace("seen.v_pov_mps", "seen.v_vut_mps")
        spec = pov(source).replace("Pov", "Vut")
        with none_left():
            ran = run(spec, CASES, hosted=True, deadline_s=DEADLINE_S)
        for case, trajectory in zip(CASES, ran, strict=True):
            if case.v_pov0_mps > GUILTY_MPS:
                assert trajectory.end is End.SIM_ERROR
                assert trajectory.error.startswith("the POV: ")
                assert how.reason in trajectory.error
                assert Measures.of(trajectory).score is None
            else:
                assert trajectory.error is None

    def test_of_the_pov_and_of_the_vut_are_told_apart(self):
        def wrong(speed: str) -> str:
            return f"def Pov(seen):\n    assert seen.{speed} < 30.0\n    return 0.0\n"

        vut = pov(wrong("v_pov_mps"), "vut.py")
        cases = own(cases_of(8))
        for trajectory in run(pov(KEEPS), cases, vut=vut):
            erred = trajectory.case.v_pov0_mps >= 30.0
            assert (trajectory.end is End.VUT_ERROR) == erred
        for trajectory in run(pov(wrong("v_vut_mps")), cases):
            erred = trajectory.case.v_pov0_mps >= 30.0
            assert (trajectory.end is End.SIM_ERROR) == erred


class TestACampaign:
    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (
                ("--level", "own"),
                "unknown POV level own: choose 0, 1, 2, all, or own with --pov",
            ),
            (("--pov", "traci"), "a TraCI client drives only the vehicle vut"),
            (("--pov", "level1"), "the POVs of levels 0 to 2 are built in"),
            (("--pov", "nowhere.py:Pov"), "the POV nowhere.py:Pov: cannot"),
        ],
    )
    def test_is_refused_in_one_sentence(self, command_line, arguments, said):
        pov(YIELDS)
        for command in ("campaign", "benchmark") if "--level" in arguments else ("campaign",):
            assert_refused(command_line(command, "--vut", "design1", *arguments), said)
        left = {path.name for path in Path().iterdir()} - {"__pycache__"}
        assert left == {"my_pov.py"}
