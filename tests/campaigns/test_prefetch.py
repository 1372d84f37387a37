"""Cases of a sampler that does not learn run ahead, and nothing that is recorded shows it."""

from __future__ import annotations

from typing import Any

import pytest
from calling import contents
from campaigning import campaign_settings, resume_campaign, run_campaign
from test_store import episode

from merge_sumo.campaigns.prefetch import Prefetch, proposals
from merge_sumo.campaigns.store import Journal
from merge_sumo.samplers.registry import SAMPLERS, make_sampler
from merge_sumo.samplers.uniform import UniformSampler
from merge_sumo.system.workers import InProcess, Workers
from merge_sumo.values.case import Pool
from merge_sumo.values.scenario import US23

SETTINGS = campaign_settings(vut="design1", sampler="uniform", cases=90, batch=20)


def recorded(folder) -> dict[str, bytes]:
    """Return what a campaign has recorded, by name."""
    files = [folder / "outcomes.jsonl", *(folder / "trajectories").iterdir()]
    return {file.name: file.read_bytes() for file in files}


class StoppedError(Exception):
    pass


def stop() -> None:
    raise StoppedError


@pytest.fixture(scope="module")
def in_turn(tmp_path_factory) -> dict:
    """What is recorded when every batch waits for the one before."""
    folder = tmp_path_factory.mktemp("in-turn") / "run"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(UniformSampler, "learns", True)
        run_campaign(SETTINGS, folder)
    return recorded(folder)


def test_a_campaign_that_runs_ahead_records_the_same_bytes(in_turn, tmp_path):
    seen = []
    run_campaign(SETTINGS, tmp_path / "run", on_case=lambda outcome: seen.append(outcome.index))
    assert recorded(tmp_path / "run") == in_turn
    assert seen == list(range(90))


def test_a_campaign_that_was_stopped_goes_on_ahead_to_the_same_bytes(
    in_turn, tmp_path, monkeypatch
):
    monkeypatch.setattr("merge_sumo.campaigns.prefetch.MAX_CHUNK", 32)
    with pytest.raises(StoppedError):
        run_campaign(SETTINGS, tmp_path / "run", check=stop)
    assert 0 < len((tmp_path / "run" / "outcomes.jsonl").read_bytes().splitlines()) < 90
    resume_campaign(tmp_path / "run")
    assert recorded(tmp_path / "run") == in_turn


@pytest.mark.parametrize("left", [0.0, 0.3, 0.5, 0.9])
def test_batches_that_were_not_written_to_their_end_run_again(in_turn, tmp_path, left):
    """All trajectories are on the disk before the first line."""
    run_campaign(SETTINGS, tmp_path / "run")
    lines = (tmp_path / "run" / "outcomes.jsonl").read_bytes()
    with (tmp_path / "run" / "outcomes.jsonl").open("r+b") as file:
        file.truncate(int(left * len(lines)))
    resume_campaign(tmp_path / "run")
    assert recorded(tmp_path / "run") == in_turn


@pytest.mark.parametrize("name", [name for name in SAMPLERS if name != "uniform"])
def test_who_learns_is_not_foreseen(name):
    assert SAMPLERS[name].learns
    assert not list(proposals(make_sampler(name, Pool(levels=(0,), scenario=US23), 0), (), 50, 20))


def test_batches_that_ended_together_are_kept_together():
    workers = Workers(InProcess, 1)

    def run(chunks):
        return workers.run_chunks(lambda items: [f"ran {item}" for item in items], chunks, str)

    batches: list[Any] = [[f"case {batch}.{place}" for place in range(20)] for batch in range(5)]
    with Prefetch(run, 1, iter(batches)) as prefetch:
        ran: Any = ([done for _, done in prefetch.run(batch)] for batch in batches)
        together: list[Any] = list(prefetch.together(ran))
    assert [batch for group in together for batch in group] == [
        [f"ran {case}" for case in batch] for batch in batches
    ]
    assert len(together) < len(batches)


def test_chunks_are_taken_when_a_worker_wants_them():
    taken = []

    def chunks():
        for number in range(100):
            taken.append(number)
            yield [number]

    with Workers(InProcess, 1) as workers:
        results = workers.run_chunks(list, chunks(), str)
        for count in range(1, 11):
            place, items = next(results)
            assert items == [place]
            assert len(taken) <= count + 2
        results.close()


def test_batches_are_written_together_as_they_are_one_by_one(tmp_path):
    batches = [[episode(2 * batch, batch), episode(2 * batch + 1, batch)] for batch in range(12)]
    with Journal.create(tmp_path / "one", {}) as journal:
        for batch in batches:
            journal.append(batch)
    with Journal.create(tmp_path / "all", {}) as journal:
        journal.append(*batches)
    one, many = contents(tmp_path / "one"), contents(tmp_path / "all")
    assert list(one.values()) == [
        many[tmp_path / "all" / p.relative_to(tmp_path / "one")] for p in one
    ]
