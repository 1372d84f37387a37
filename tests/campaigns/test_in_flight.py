"""Cases in flight: the number of workers, the time of a case and a stop decide nothing."""

# mypy: no-strict-optional

from __future__ import annotations

import shutil
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from campaigning import campaign_settings, resume_campaign, run_campaign

from merge_sumo.campaigns.campaign import conduct
from merge_sumo.campaigns.in_flight import AGE, GROUPS, Flight, by_rounds, conduct_in_flight
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.campaigns.store import OUTCOMES, TRAJECTORIES, Run, read_settings
from merge_sumo.engine.evaluate import CaseResult
from merge_sumo.errors import UserError
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.system.workers import dask_workers
from merge_sumo.testing.contracts import episode, play_case
from merge_sumo.values.case import Pool
from merge_sumo.values.scenario import US23
from merge_sumo.values.score import measure

POOL = Pool(levels=(0, 1), scenario=US23)
LEARNING = sorted(name for name, kind in SAMPLERS.items() if kind.learns)


def settings(sampler: str = "coverage", **changes: Any) -> CampaignSettings:
    values = {"vut": "design1", "cases": 60, "in_flight": 12, "seed": 2}
    return campaign_settings(sampler=sampler, **{**values, **changes})


def outcomes(folder: Path) -> bytes:
    return (folder / OUTCOMES).read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Return the folder of a campaign that ran in this process, undisturbed."""
    return run_campaign(settings(), tmp_path_factory.mktemp("whole") / "run").folder


def results_in(order: np.random.Generator):
    """Return what runs chunks of cases, of which any of those that run may end next."""

    def run(chunks):
        running, first = [], 0
        while True:
            chunk = next(chunks, None)
            if chunk:
                running.append((first, chunk))
                first += len(chunk)
            if not running:
                return
            if not chunk or order.random() < 0.3:
                place, cases = running.pop(int(order.integers(len(running))))
                motions = [episode(case) for case in cases]
                yield place, [CaseResult(measure(motion, None), motion) for motion in motions]

    return run


def searched(
    name: str, order: int, chunk: int, cases: int = 70, in_flight: int = 20, history=()
) -> list[Any]:
    """Return the outcomes of a search whose cases end in an order of their own."""
    sampler = make_sampler(name, POOL, 3)
    flight = Flight(sampler, cases, in_flight, history)
    run = results_in(np.random.default_rng(order))
    groups = conduct_in_flight(flight, run, lambda _: chunk)
    return [*history, *(o for together in groups for group in together for o, _ in group)]


def ends_of_groups(outcomes) -> list[int]:
    """Return the numbers of cases that are whole groups."""
    return [after.index for before, after in pairwise(outcomes) if after.batch > before.batch]


@pytest.mark.slow
@pytest.mark.parametrize("name", LEARNING)
def test_a_search_depends_neither_on_the_order_of_ends_nor_on_chunks_nor_on_a_stop(name):
    expected = searched(name, 0, 1)
    assert [outcome.index for outcome in expected] == list(range(70))
    assert searched(name, 1, 3) == expected
    for end in ends_of_groups(expected)[1::5]:
        assert searched(name, end, 2, history=expected[:end]) == expected


def test_no_more_cases_than_allowed_are_in_flight():
    asked: list[tuple[int, int, int]] = []

    class Watched(UniformSampler):
        def ask(self, n):
            asked.append((len(self._outcomes), self.proposed(), n))
            return super().ask(n)

        def batch_size(self):
            return 6

    flight = Flight(Watched(POOL, 0), 400, 24)
    list(conduct_in_flight(flight, results_in(np.random.default_rng(0)), lambda _: 1))
    assert sum(n for *_, n in asked) == 400
    for told, proposed, n in asked:
        most = min(24, 6 + proposed // AGE)
        assert proposed + n - told <= most
        # No more is told than has to be.
        assert not told or proposed + n - told > most - most // GROUPS
    assert {n for *_, n in asked if n > 1} > {2, 24 // GROUPS}


def test_a_sampler_that_is_not_asked_while_cases_run_waits_for_them():
    for outcome, after in zip(
        *(searched("subset", 0, 1)[place:] for place in (0, 1)), strict=False
    ):
        assert after.batch - outcome.batch == (after.index % 20 == 0)


def test_many_in_flight_are_batches_for_a_sampler_that_waits():
    """So the published baselines do what they do in batches of so many cases."""

    def run(cases):
        motions = [episode(case) for case in cases]
        return enumerate(CaseResult(measure(motion, None), motion) for motion in motions)

    sampler = make_sampler("annealing", POOL, 3)
    batches = conduct(sampler, run, 70, 20)
    assert [o for batch in batches for o, _ in batch] == searched("annealing", 0, 1)


class TestACampaign:
    @pytest.mark.parametrize("lost", [1, 700, "half"])
    def test_has_the_same_bytes_after_a_cut_anywhere(self, whole, tmp_path, lost):
        folder = Path(shutil.copytree(whole, tmp_path / "run"))
        text = outcomes(folder)
        (folder / OUTCOMES).write_bytes(text[: len(text) // 2 if lost == "half" else -lost])
        said: list = []
        resume_campaign(folder, warn=said.append)
        assert outcomes(folder) == outcomes(whole)
        assert "dropped" in said[0]

    @pytest.mark.slow
    def test_has_the_same_bytes_after_each_cut(self, whole, tmp_path):
        lines = outcomes(whole).splitlines(keepends=True)
        for kept in range(0, len(lines), 3):
            folder = Path(shutil.copytree(whole, tmp_path / str(kept)))
            (folder / OUTCOMES).write_bytes(b"".join(lines[:kept]))
            resume_campaign(folder)
            assert outcomes(folder) == outcomes(whole)
            assert {path.name for path in (folder / TRAJECTORIES).iterdir()} == {
                path.name for path in (whole / TRAJECTORIES).iterdir()
            }

    @pytest.mark.slow
    def test_grows_as_one_that_had_the_cases_from_the_start(self, whole, tmp_path):
        ends = ends_of_groups(Run(whole).outcomes)
        folder = run_campaign(settings(cases=ends[-3]), tmp_path / "run").folder
        resume_campaign(folder, {"cases": 60})
        assert outcomes(folder) == outcomes(whole)

    def test_records_what_decides_its_outcomes(self, whole, tmp_path):
        assert read_settings(whole)["in_flight"] == 12
        folder = Path(shutil.copytree(whole, tmp_path / "run"))
        with pytest.raises(UserError, match="in_flight differs"):
            resume_campaign(folder, {"in_flight": 13, "cases": 70})

    @pytest.mark.slow
    def test_that_converges_ends_where_it_would_have_ended(self, tmp_path):
        eager = settings(cases=400, in_flight=10, stop_when_converged=True)
        run = run_campaign(eager, tmp_path / "run")
        count = len(run.outcomes)
        assert count < 400
        lines = outcomes(run.folder).splitlines(keepends=True)
        (run.folder / OUTCOMES).write_bytes(b"".join(lines[: count // 2]))
        resume_campaign(run.folder)
        assert outcomes(run.folder) == b"".join(lines)

    @pytest.mark.slow
    def test_runs_on_dask(self, whole, tmp_path):
        distributed = pytest.importorskip("distributed", reason="needs merge-sumo[dask]")
        cluster = distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None, host="127.0.0.1"
        )
        with cluster, dask_workers(cluster.scheduler_address) as workers:
            run_campaign(settings(), tmp_path / "run", workers=workers)
        assert outcomes(tmp_path / "run") == outcomes(whole)


def test_a_stopping_rule_is_asked_after_every_n_cases():
    batches: list[set[int]] = []

    def rule(known) -> bool:
        batches.append({outcome.batch for outcome in known})
        return False

    stop = by_rounds(rule, 10)
    cases = make_sampler("uniform", POOL, 0).ask(40)
    known = [play_case(index, index // 3, case) for index, case in enumerate(cases)]
    for told in (9, 10, 25):
        assert not stop(known[:told], told)
    assert batches == [set(), {0}, {0, 1}]
    assert by_rounds(None, 10) is None


@pytest.mark.parametrize(
    ("changes", "sentence"),
    [
        ({"in_flight": 0}, "--in-flight is 0: it must be 1 or more"),
        ({"in_flight": 8, "batch": 4}, "leave one of them away"),
        ({"in_flight": 90, "cases": 80}, "no more cases can be in flight"),
        ({"in_flight": 8, "sampler": "uniform"}, "--sampler uniform waits for none"),
    ],
)
def test_nonsense_is_refused_in_a_sentence(changes, sentence):
    with pytest.raises(UserError, match=sentence):
        settings(**changes)
