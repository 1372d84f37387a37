"""Contracts of extensions: classes of tests that pytest runs in your subclass.

    from merge_sumo.testing import SamplerContract
    from my_package import MySampler

    class TestMySampler(SamplerContract):
        sampler = MySampler

A contract is imported without pytest. Only `VutContract` runs SUMO.
"""

from __future__ import annotations

from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from merge_sumo import api
from merge_sumo.campaigns.campaign import run_campaign
from merge_sumo.campaigns.recorded import RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.controllers.kinds import load
from merge_sumo.files import ScratchFolder
from merge_sumo.metrics.measures import Measure, measures_of
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.contract import SamplerContract, play, play_case
from merge_sumo.scenario.case import Case, Pool
from merge_sumo.scenario.scenario import DT_S, US23, VUT, Scenario
from merge_sumo.scenario.trajectory import End, Trajectory

__all__ = [
    "MeasureContract",
    "SamplerContract",
    "VutContract",
    "episode",
    "play",
    "play_case",
]


def episode(case: Case) -> Trajectory:
    """Return an episode without SUMO: every vehicle keeps its speed until the VUT is at M.

    Args:
        case: the case; its VUT moves.
    """
    starts = np.array(case.starts())  # (A, 2) of x and v
    steps = int(np.ceil(-starts[VUT, 0] / (starts[VUT, 1] * DT_S)))
    time_s = np.arange(steps + 1)[:, None] * DT_S
    x_m, v_mps = starts[:, 0] + starts[:, 1] * time_s, np.tile(starts[:, 1], (steps + 1, 1))
    return Trajectory(case, np.stack([x_m, v_mps, np.zeros_like(x_m)], axis=2), End.MERGED, None)


class MeasureContract:
    """Contract of a measure: a pure function of an episode.

    Example:
        class TestMyMeasure(MeasureContract):
            measure = MY_MEASURE

    Attributes:
        measure: the measure under test.
        pool: cases of the episodes.
    """

    measure: Measure[Any]
    pool: Pool = Pool(levels=(0,), scenario=US23)

    def values(self) -> list[float | None]:
        """Return the values of some episodes."""
        points = np.random.default_rng(0).random((10, 2))
        episodes = map(episode, self.pool.cases(points, self.pool.levels[0]))
        return list(map(self.measure.function, measures_of(list(episodes), None)))

    def test_says_what_it_is(self) -> None:
        assert self.measure.name.isidentifier()
        assert self.measure.about
        assert "\n" not in self.measure.about
        assert not self.measure.about.endswith(".")
        assert self.measure.missing is not None

    def test_is_a_number_or_none_and_the_same_again(self) -> None:
        """A record holds numbers of Python, and not those of arrays."""
        values = self.values()
        assert all(value is None or type(value) is float for value in values)
        assert values == self.values()

    def test_leaves_the_episode_alone(self) -> None:
        """Other measures use the same episode."""
        (case,) = self.pool.cases(np.full((1, 2), 0.5), self.pool.levels[0])
        trajectory = episode(case)
        before = trajectory.motion.copy()
        self.measure.function(*measures_of([trajectory], None))
        assert np.array_equal(before, trajectory.motion)


_kept: list[ScratchFolder] = []
"""Folders that stay until the process ends."""


@cache
def campaign_of(vut: str = "level0", scenario: Scenario = US23) -> RecordedCampaign:
    """Return a campaign of 20 cases in SUMO at level 0; its folder stays until the process ends.

    Args:
        vut: spec of the VUT.
        scenario: the scenario; its own criterion decides what fails.
    """
    scratch = ScratchFolder()
    _kept.append(scratch)
    folder = Path(scratch.name) / "run"
    settings = CampaignSettings(
        vut=vut,
        levels=(0,),
        sampler="uniform",
        cases=20,
        seed=1,
        scenario=scenario,
        fail_when=scenario.criterion,
    )
    return run_campaign(settings, settings.load_plan(), folder)


class VutContract:
    """Contract of a VUT, at a point and on an acceleration lane.

    Example:
        class TestMyVut(VutContract):
            vut = "my_vut.py:MyVut"

    Attributes:
        vut: the text after `--vut`.
        scenarios: names of the shipped scenarios in which it drives.
    """

    vut: str
    scenarios: tuple[str, ...] = ("us23", "us23-lane")

    def runs(self) -> list[RecordedCampaign]:
        """Return a campaign in each scenario."""
        return [campaign_of(self.vut, named_scenario(name)) for name in self.scenarios]

    def test_answers_in_every_step(self) -> None:
        for run in self.runs():
            for outcome in run.outcomes:
                assert outcome.measures.error is None, run.record["scenario"]

    def test_does_not_depend_on_other_corridors(self) -> None:
        """A case alone has the outcome that it had among others."""
        for run in self.runs():
            for index in (0, 7):
                alone = api.run(self.vut, recorded=(run.folder, index))
                assert alone.measures == run.outcome(index).measures

    def test_is_found_again_by_its_name(self) -> None:
        """A worker gets the name and makes the controller again."""
        first, second = load(self.vut), load(self.vut)
        assert first == second
        assert first.files == second.files
