"""The loop of a campaign: workers and a stop decide nothing."""

# mypy: no-strict-optional

from __future__ import annotations

from collections import Counter
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
from support.campaigning import campaign_settings, run_campaign
from support.plans import plan_for

from merge_sumo.campaigns.journal import to_line
from merge_sumo.campaigns.loop import AGE, BATCHES_IN_FLIGHT, SearchLoop
from merge_sumo.campaigns.recorded import OUTCOMES, TRAJECTORIES
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import UserError
from merge_sumo.metrics.criterion import PAPER_CRITERION
from merge_sumo.metrics.outcome import Episode
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import US23
from merge_sumo.testing.contracts import episode
from merge_sumo.workers import Job, Workers, open_workers

POOL = Pool(levels=(0, 1), scenario=US23)
LEARNING = sorted(name for name, kind in SAMPLERS.items() if kind.learns)


def played(case) -> Episode:
    """Return what becomes of a case, without SUMO."""
    trajectory = episode(case)
    return Episode(PAPER_CRITERION.outcome(trajectory), trajectory)


class Played(Workers):
    """Workers that play their cases without SUMO."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count

    def submit(self, function, items, lost, chunk=None) -> Job[Any, Any]:
        return Job(function, [items], lost)

    def collect(self, job: Job[Any, Any]) -> list[Any]:
        return [played(case) for case in job.chunks[0]]


PLAN = plan_for("design1")


def found(sampler, cases: int = 70, *, workers: int = 1, **how: Any) -> list[Episode]:
    """Return the episodes of a search."""
    groups: list[list[Episode]] = []
    SearchLoop(sampler, PLAN, cases, workers=Played(workers), **how).run(groups.extend)
    return [one for group in groups for one in group]


def lines(episodes: list[Episode]) -> list[str]:
    """Return the lines of a search."""
    return [to_line(one.outcome) for one in episodes]


class Asked(UniformSampler):
    """Notes what it was told, and what is pending, whenever it is asked."""

    learns = overlaps = True
    size = 40

    def __init__(self) -> None:
        super().__init__(POOL, 0)
        self.asked: list[tuple[int, int, int]] = []

    def ask(self, n):
        self.asked.append((n, len(self._outcomes), len(self._pending)))
        return super().ask(n)

    def batch_size(self):
        return self.size


class TestRoom:
    """(cases of a group, cases told before, cases pending)"""

    def asked(self, cases: int, *, size: int = 40, **how: Any) -> list:
        sampler = Asked()
        sampler.size = size
        found(sampler, cases, **how)
        return sampler.asked

    @pytest.mark.parametrize(
        ("how", "asked"),
        [
            ({"cases": 5, "batch": 2}, [(2, 0, 0), (2, 2, 0), (1, 4, 0)]),
            ({"cases": 4, "in_flight": 3}, [(1, 0, 0), (1, 0, 1), (1, 0, 2), (1, 1, 2)]),
            ({"cases": 3, "in_flight": 1}, [(1, 0, 0), (1, 1, 0), (1, 2, 0)]),
        ],
    )
    def test_is_for_a_batch_or_for_cases_in_flight(self, how, asked):
        assert self.asked(**how) == asked

    def test_grows_with_what_is_known(self):
        asked = self.asked(400, in_flight=24, size=6)
        assert sum(n for n, *_ in asked) == 400
        for n, told, pending in asked:
            most = min(24, 6 + (told + pending) // AGE)
            assert pending + n <= most
            # No more is told than has to be.
            assert not told or pending + n > most - most // BATCHES_IN_FLIGHT
        assert {n for n, *_ in asked if n > 1} > {2, 24 // BATCHES_IN_FLIGHT}

    def test_is_for_several_groups_where_outcomes_decide_nothing(self, monkeypatch):
        monkeypatch.setattr(Asked, "learns", False)
        assert self.asked(5, batch=2) == [(2, 0, 0), (2, 0, 2), (1, 0, 4)]

    def test_is_for_one_group_where_outcomes_may_end_the_search(self, monkeypatch):
        monkeypatch.setattr(Asked, "learns", False)
        asked = self.asked(9, batch=2, stop=lambda known: len(known) >= 4)
        assert asked == [(2, 0, 0), (2, 2, 0)]


@pytest.mark.parametrize("how", [{"batch": 9}, {"batch": 4}, {"in_flight": 8}])
def test_every_case_runs_as_often_as_stated_however_batches_are_cut(how):
    ran = found(make_sampler("coverage", POOL, 1), 26, repeat=3, **how)
    runs = Counter(one.outcome.case.start for one in ran)
    assert list(runs.values()) == [3] * 8 + [2]
    assert [one.outcome.case.draw for one in ran] == [0, 1, 2] * 8 + [0, 1]


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNING)
def test_a_search_depends_neither_on_workers_nor_on_a_stop(name):
    def of(**how: Any) -> list[Episode]:
        return found(make_sampler(name, POOL, 3), 36, in_flight=20, **how)

    kept = of()
    assert [one.outcome.index for one in kept] == list(range(36))
    assert lines(of(workers=3)) == lines(kept)
    for end in ends_of_groups([one.outcome for one in kept])[1::12]:
        assert lines(of(workers=2, history=kept[:end])) == lines(kept[end:])


def ends_of_groups(outcomes) -> list[int]:
    """Return the numbers of cases that are whole groups."""
    return [after.index for before, after in pairwise(outcomes) if after.batch > before.batch]


def settings(sampler: str = "gpr", **changes: Any) -> CampaignSettings:
    values = {"vut": "design1", "cases": 60, "in_flight": 12, "seed": 2}
    return campaign_settings(sampler=sampler, **{**values, **changes})


def recorded(folder: Path) -> dict[str, bytes]:
    """Return what a campaign has recorded, by name."""
    files = [folder / OUTCOMES, *(folder / TRAJECTORIES).iterdir()]
    return {file.name: file.read_bytes() for file in files}


def test_cases_in_flight_give_the_same_bytes_on_any_workers(tmp_path):
    few = settings(cases=16, in_flight=8, levels=(0, 1))
    run_campaign(few, tmp_path / "1")
    with open_workers(2) as two:
        run_campaign(few, tmp_path / "2", workers=two)
    assert recorded(tmp_path / "1") == recorded(tmp_path / "2")


def test_cases_ahead_are_recorded_as_in_turn(tmp_path, monkeypatch):
    uniform = campaign_settings(vut="design1", sampler="uniform", cases=90, batch=20)
    seen: list[int] = []
    run_campaign(uniform, tmp_path / "ahead", on_case=lambda one: seen.append(one.index))
    assert seen == list(range(90))
    monkeypatch.setattr(UniformSampler, "learns", True)
    run_campaign(uniform, tmp_path / "in turn")
    assert recorded(tmp_path / "ahead") == recorded(tmp_path / "in turn")


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"in_flight": 0}, "`in_flight` is 0: it must be 1 or more"),
        ({"in_flight": 8, "batch": 4}, "`in_flight` and `batch` cannot be combined"),
    ],
)
def test_nonsense_is_refused_in_a_sentence(changes, sentence):
    with pytest.raises(UserError, match=sentence):
        settings(**changes)
