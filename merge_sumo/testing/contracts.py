"""Contracts of what extends merge-sumo: classes of tests that pytest runs in your subclass.

    from merge_sumo.testing import SamplerContract
    from my_package import MySampler

    class TestMySampler(SamplerContract):
        sampler = MySampler

A contract needs no pytest to be imported, and no SUMO unless it says so.
"""

from __future__ import annotations

import json
import math
import tempfile
from contextlib import closing
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import numpy as np

from merge_sumo import api
from merge_sumo.campaigns.run import Run
from merge_sumo.drivers.base import Scene
from merge_sumo.drivers.policies import policies_of
from merge_sumo.engine.plan import SimulationPlan
from merge_sumo.engine.povs import Povs
from merge_sumo.engine.simulator import Simulator
from merge_sumo.errors import UserError
from merge_sumo.reports.export_format import ExportFormat
from merge_sumo.reports.report_model import ReportModel
from merge_sumo.reports.report_sections import ReportSection
from merge_sumo.road.merge import road_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.contract import SamplerContract, play, play_case
from merge_sumo.scenario.case import Case, FloatArray, MergeCase, Pool, ToldCase, from_unit
from merge_sumo.scenario.imperfection import Sensing
from merge_sumo.scenario.kinds import SCENARIO_KINDS, scenario_of_record
from merge_sumo.scenario.scenario import DT_S, US23, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory
from merge_sumo.sumo.world import World
from merge_sumo.system.scratch import ScratchFolder
from merge_sumo.verdict.criteria import NamedCriterion
from merge_sumo.verdict.criterion import Criterion
from merge_sumo.verdict.measures import Measure
from merge_sumo.verdict.score import Outcome
from merge_sumo.vuts.factory import VutFactory

__all__ = [
    "CriterionContract",
    "ExportContract",
    "MeasureContract",
    "ReportSectionContract",
    "SamplerContract",
    "ScenarioKindContract",
    "VutContract",
    "assert_sees_late",
    "episode",
    "play",
    "play_case",
]


def episode(case: Case) -> Trajectory:
    """Return an episode without SUMO: every vehicle keeps its speed until the VUT is at M."""
    starts = np.array(case.starts())  # (A, 2) of x and v
    steps = int(np.ceil(-starts[VUT, 0] / (starts[VUT, 1] * DT_S)))
    time_s = np.arange(steps + 1)[:, None] * DT_S
    x_m, v_mps = starts[:, 0] + starts[:, 1] * time_s, np.tile(starts[:, 1], (steps + 1, 1))
    return Trajectory(case, np.stack([x_m, v_mps, np.zeros_like(x_m)], axis=2), End.MERGED, None)


class MeasureContract:
    """What records, conditions and pages rely on in a measure: a pure function of an episode.

    Attributes:
        measure: the measure under test.
        pool: cases of the episodes.
    """

    measure: Measure
    pool: Pool = Pool(levels=(0,), scenario=US23)

    def values(self) -> list[float | None]:
        """Return the values of some episodes."""
        assert self.measure.of is not None
        cases = self.pool.cases(np.random.default_rng(0).random((10, 2)), self.pool.levels[0])
        return [self.measure.of(episode(case), None) for case in cases]

    def test_says_what_it_is(self) -> None:
        assert self.measure.name.isidentifier()
        assert self.measure.about
        assert "\n" not in self.measure.about
        assert not self.measure.about.endswith(".")
        assert self.measure.missing is not None

    def test_is_a_number_or_none_and_the_same_again(self) -> None:
        """Not a number of an array, which a record does not hold."""
        values = self.values()
        assert all(value is None or type(value) is float for value in values)
        assert values == self.values()

    def test_leaves_the_episode_alone(self) -> None:
        """Other measures look at it, too."""
        assert self.measure.of is not None
        (case,) = self.pool.cases(np.full((1, 2), 0.5), self.pool.levels[0])
        trajectory = episode(case)
        before = trajectory.motion.copy()
        self.measure.of(trajectory, None)
        assert np.array_equal(before, trajectory.motion)


class CriterionContract:
    """What a campaign relies on in a named criterion.

    Attributes:
        criterion: the criterion under test.
    """

    criterion: NamedCriterion

    def test_some_cases_fail_and_others_do_not(self) -> None:
        """`check` refuses a condition that no case meets, or every one."""
        Criterion(self.criterion.condition).check(US23)
        assert self.criterion.about


_kept: Final[list[ScratchFolder]] = []
"""Folders that stay until the process ends."""


@cache
def campaign_of(vut: str = "level0", scenario: Scenario = US23) -> Run:
    """Return a campaign in SUMO at level 0; its folder stays until the process ends."""
    scratch = ScratchFolder()
    _kept.append(scratch)
    folder = Path(scratch.name) / "run"
    keywords: dict[str, Any] = {"level": 0, "sampler": "uniform", "cases": 20, "seed": 1}
    return api.campaign(vut, out=folder, scenario=scenario, progress=False, **keywords).run


class ScenarioKindContract:
    """What a campaign relies on in a kind of scenario, which is registered.

    Attributes:
        scenario_kind: the subclass of `Scenario` under test.
        vut: what drives in it.
    """

    scenario_kind: type[Any]
    vut: str = "level0"

    def test_is_read_back_from_its_record(self) -> None:
        """The record of a run names the kind."""
        scenario = self.scenario_kind()
        assert SCENARIO_KINDS[self.scenario_kind.kind] is self.scenario_kind
        assert scenario_of_record(json.loads(json.dumps(scenario.to_record()))) == scenario

    def test_has_coordinates_with_names(self) -> None:
        """Maps and tables show them, and a case has a field for each."""
        scenario = self.scenario_kind()
        for level in scenario.levels:
            middle = np.full((1, len(scenario.dimensions(level))), 0.5)
            (case,) = from_unit(middle, level, scenario=scenario)
            assert len(case.starts()) == scenario.vehicles
            for dimension in scenario.dimensions(level):
                assert dimension.field in scenario.notation
                assert dimension.low < getattr(case, dimension.field) < dimension.high

    def test_refuses_cases_that_make_no_scenario(self) -> None:
        """A coordinate that is no number is a `UserError`."""
        scenario = self.scenario_kind()
        for name in {dimension.field for dimension in scenario.dimensions(0)}:
            middle = {d.field: (d.low + d.high) / 2.0 for d in scenario.dimensions(0)}
            try:
                scenario.case_type(level=0, scenario=scenario, **{**middle, name: math.nan})
            except UserError:
                continue
            raise AssertionError(f"{name} of NaN is accepted")

    def test_says_of_every_corridor_whether_its_episode_has_ended(self) -> None:
        """The engine asks for all K at once."""
        scenario = self.scenario_kind()
        ended = scenario.has_ended(*np.zeros((2, scenario.vehicles, 3)))
        assert ended.shape == (3,)
        assert ended.dtype == np.bool_

    def test_runs_in_sumo(self) -> None:
        """No case ends in an error, and some are tested."""
        run = campaign_of(self.vut, self.scenario_kind())
        ends = [outcome.measures.end for outcome in run.outcomes]
        assert not [end for end in ends if end.is_error]
        assert [end for end in ends if end.is_tested]

    def test_outcomes_are_read_back_from_their_records(self) -> None:
        """A line of `outcomes.jsonl` says everything."""
        scenario = self.scenario_kind()
        for outcome in campaign_of(self.vut, scenario).outcomes:
            line = json.dumps(outcome.to_record())
            assert Outcome.from_json(line, scenario) == outcome


LATE_STEPS: Final = 2
"""By so many steps the sensors are late."""


def assert_sees_late(factory: VutFactory) -> None:
    """Assert that a VUT with late sensors answers to the log of its episode, shifted.

    It drives once with such sensors; then it is asked again, without any, about the positions and
    speeds of the POV that many steps before, and those of the VUT at the time.
    """
    late = replace(US23, sense=Sensing(delay_s=LATE_STEPS * DT_S))
    case = MergeCase(level=1, x_pov0_m=-260.0, v_pov0_mps=29.0, scenario=late)
    road, povs = road_of(), Povs(policies=policies_of(US23))
    plan = SimulationPlan(
        scenario=late, road=road, vut=factory, povs=povs, criterion=Criterion(), corridors=1
    )
    with Simulator(plan) as simulator:
        (ran,) = simulator.run([case])
    assert ran.error is None
    seen = shifted(ran.motion, LATE_STEPS)
    told = tuple(map(tuple, seen[0, :, :2].tolist()))
    with World(1, road, scenario=US23) as world, closing(factory(1, world)) as driver:
        driver.begin(0, ToldCase(level=1, scenario=US23, told=told))
        answers = []
        for step, state in enumerate(seen[:-1]):
            x_m, v_mps = state[:, 0, None], state[:, 1, None]
            scene = Scene(np.array([True]), np.array([step]), x_m, v_mps)
            answers.append(float(driver.act(scene)[0]))
    obeyed = np.clip(answers, US23.a_min_mps2, US23.a_max_mps2)
    assert np.array_equal(obeyed, ran.a_vut_mps2[:-1]), "it answers to something else"


def shifted(motion: FloatArray, steps: int) -> FloatArray:
    """Return a motion, (T + 1, A, 3), with the other cars where they were some steps before.

    Before the start they drove as they start.
    """
    before = np.repeat(motion[:1], steps, axis=0)
    before[:, :, 0] += before[:, :, 1] * (np.arange(-steps, 0) * DT_S)[:, None]
    late = np.concatenate((before, motion))[: len(motion)]
    late[:, VUT] = motion[:, VUT]
    return late


class VutContract:
    """What a campaign relies on in a VUT, at a point and on an acceleration lane.

    Attributes:
        vut: what a person writes after `--vut`.
        scenarios: names of the shipped scenarios in which it drives.
    """

    vut: str
    scenarios: tuple[str, ...] = ("us23", "us23-lane")

    def runs(self) -> list[Run]:
        """Return a campaign in each scenario."""
        return [campaign_of(self.vut, named_scenario(name)) for name in self.scenarios]

    def test_answers_in_every_step(self) -> None:
        for run in self.runs():
            errors = {outcome.measures.error for outcome in run.outcomes}
            assert errors == {None}, run.record["scenario"]

    def test_does_not_depend_on_other_corridors(self) -> None:
        """A case alone has the outcome that it had among others."""
        for run in self.runs():
            for index in (0, 7):
                alone = api.run(self.vut, recorded=(run.folder, index))
                assert alone.measures == run.outcome(index).measures

    def test_sees_with_late_sensors_what_was_before(self) -> None:
        """SUMO's own drivers see in SUMO, and have no sensors."""
        factory = VutFactory.of(self.vut)
        if factory.vut.vut_type is None:
            assert_sees_late(factory)

    def test_is_found_again_by_its_name(self) -> None:
        """A worker is told the name and makes it anew."""
        first, second = (VutFactory.of(self.vut) for _ in range(2))
        assert first == second
        assert first.files == second.files


class ExportContract:
    """What `merge-sumo export` relies on in a format.

    Attributes:
        export_format: the format under test.
    """

    export_format: ExportFormat

    def written(self, folder: Path) -> Path:
        """Return the path that the format says it has written below a folder."""
        run, export_format = campaign_of(), self.export_format
        if export_format.write_table is not None:
            return export_format.write_table(run, [0, 3], folder)
        assert export_format.write_case is not None
        return export_format.write_case(run, 3, folder, road_of())

    def test_writes_below_the_folder_that_it_is_told(self) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            path = self.written(Path(scratch) / "new")
            assert path.is_relative_to(Path(scratch) / "new")
            assert path.stat().st_size

    def test_writes_the_same_bytes_again(self) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            paths = [self.written(Path(scratch) / name) for name in ("a", "b")]
            assert paths[0].read_bytes() == paths[1].read_bytes()

    def test_replaces_nothing(self) -> None:
        with tempfile.TemporaryDirectory() as scratch:
            path = self.written(Path(scratch) / "new")
            path.write_bytes(b"of somebody else")
            try:
                self.written(Path(scratch) / "new")
            except UserError:
                assert path.read_bytes() == b"of somebody else"
            else:
                raise AssertionError("another file in its place is a UserError")


class ReportSectionContract:
    """What the page relies on in a section.

    Attributes:
        section: the section under test.
    """

    section: ReportSection

    def html(self) -> str:
        """Return the section of a campaign; "" where it is left out."""
        return self.section.html(ReportModel(campaign_of()))

    def test_is_one_section_or_nothing(self) -> None:
        html = self.html().strip()
        assert not html or html.count("<section") == html.count("</section>") == 1

    def test_loads_and_runs_nothing(self) -> None:
        """The policy of the page would stop it."""
        html = self.html().lower()
        assert not [word for word in ("<script", "<style", " src=", "javascript:") if word in html]

    def test_is_the_same_again(self) -> None:
        assert self.html() == self.html()
