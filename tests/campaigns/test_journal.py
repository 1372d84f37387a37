"""What a campaign remembers survives exactly, and what cannot be read is named."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import os
import resource
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from support.handmade import FOLLOWED_UP

from merge_sumo.campaigns.journal import Journal, to_line
from merge_sumo.campaigns.recorded import RecordedCampaign, read_outcomes, read_settings
from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import OURS, Measures
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.road.loader import centre_lines, road_for
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End, Trajectory

SPEC_FIELDS = [
    *("index", "batch", "level", "x_pov0_m", "v_pov0_mps", "v_vut0_mps", "svo_rad", "end"),
    *("score", "dx_m", "dv_mps", "ttc_s", "pet_s", "t_end_s"),
]
"""The record of SPEC 10 up to its dots; "error" closes it."""


def episode(index: int, batch: int = 0, steps: int = 60) -> Episode:
    """Return an episode with numbers that no short decimal holds."""
    rng = np.random.default_rng(index)
    case = Case(
        level=0, x_pov0_m=-200.0 - index / 3.0, v_pov0_mps=30.0 + 1.0 / (index + 3.0), scenario=US23
    )
    motion = rng.normal(size=(steps + 1, 2, 3))
    motion[:, :, 0] = np.linspace(-180.0, -1.0, steps + 1)[:, None]
    motion[-1, :, 0] = rng.uniform(0.0, 2.0, 2)
    trajectory = Trajectory(case, motion, End.MERGED)
    return Episode(Outcome(index, batch, case, Measures.of(trajectory)), trajectory)


def lines_of(count: int) -> list[bytes]:
    return [to_line(episode(index).outcome).encode() for index in range(count)]


def assert_sentence(error: pytest.ExceptionInfo[UserError], *parts: str) -> None:
    message = str(error.value)
    assert "\n" not in message
    for part in parts:
        assert part in message


class TestARecord:
    def test_survives_to_the_last_bit(self, run):
        # repr tells floats apart that == does not: -0.0 and 0.0.
        odd = {"ttc_s": -0.0, "dx_m": 5e-324, "score": -1e300, "error": 'é\n\u2028"'}
        record = {**run.outcomes[0].to_record(), **odd}
        text = json.dumps(record) + "\n"
        assert to_line(Outcome.from_json(text, scenario=US23)) == text
        for outcome in run.outcomes:
            line = to_line(outcome)
            again = Outcome.from_json(line, scenario=US23)
            assert again == outcome
            assert to_line(again) == line

    def test_has_the_fields_of_the_specification_in_their_order(self):
        names = [n for n in episode(0).outcome.to_record() if n in (*SPEC_FIELDS, *OURS)]
        assert names[: len(SPEC_FIELDS)] == SPEC_FIELDS
        assert names[-len(FOLLOWED_UP) :] == list(FOLLOWED_UP)


def read(text: bytes) -> tuple[list[Outcome], bool]:
    return read_outcomes(text, "outcomes.jsonl", scenario=US23)


class TestReading:
    def test_drops_a_last_line_that_is_torn_at_any_byte(self):
        whole, last = b"".join(lines_of(2)), lines_of(3)[2]
        before = [episode(0).outcome, episode(1).outcome]
        for cut in range(1, len(last)):
            assert read(whole + last[:cut]) == (before, True)
        assert len(read(whole + last)[0]) == 3

    @pytest.mark.parametrize(("order", "line"), [([1, 0, 2], 1), ([0, 2], 2), ([0, 1, 1], 3)])
    def test_names_the_first_line_that_is_not_in_its_place(self, order, line):
        lines = lines_of(3)
        with pytest.raises(UserError) as error:
            read(b"".join(lines[index] for index in order))
        assert_sentence(error, f"line {line} ")


class TestAJournal:
    def test_gives_back_settings_outcomes_and_trajectories_to_the_last_bit(self, tmp_path):
        settings = {"vut": "design1", "levels": [0], "seed": 3, "tolerated": 0.1 + 0.2}
        journal = Journal.create(tmp_path / "run", settings)
        ran = [episode(index, batch=index // 2, steps=20 + 7 * index) for index in range(5)]
        for batch in range(3):
            journal.append([one for one in ran if one.outcome.batch == batch])
        run = RecordedCampaign(tmp_path / "run")
        assert run.record == settings
        assert run.outcomes == [one.outcome for one in ran]
        for index in (4, 0, 3, 1, 2):
            again = run.trajectory(index)
            assert again.motion.dtype == np.float64
            assert again.motion.shape == ran[index].trajectory.motion.shape
            assert again.motion.tobytes() == ran[index].trajectory.motion.tobytes()
            assert again.case == ran[index].trajectory.case

    def test_notes_what_episodes_tell_of_the_settings(self, tmp_path):
        first = replace(episode(0), files={"a": "2", "b": "3"}, ran_again=True)
        second = replace(episode(1, 1), pov_files={"c": "4"})
        with Journal.create(tmp_path / "run", {"vut_files": {"a": "1"}, "pov_files": None}) as to:
            for one, in_vain in ((first, ("a", "b")), (second, ("a",))):
                to.append([replace(one, trajectory=replace(one.trajectory, in_vain=in_vain))])
        assert read_settings(tmp_path / "run") == {
            "vut_files": {"a": "1", "b": "3"},
            "pov_files": {"c": "4"},
            "in_vain": {"a": 2, "b": 1},
            "ran_again": 1,
        }

    def test_syncs_the_trajectories_before_the_outcomes(self, tmp_path, monkeypatch):
        journal = Journal.create(tmp_path / "run", {"vut": "v"})
        synced, fsync = [], os.fsync

        def note(file: int) -> None:
            synced.append(os.fstat(file).st_ino)
            fsync(file)

        monkeypatch.setattr(os, "fsync", note)
        journal.append([episode(0)])
        (trajectories,) = (tmp_path / "run" / "trajectories").iterdir()
        outcomes = tmp_path / "run" / "outcomes.jsonl"
        files = [trajectories, trajectories.parent, outcomes]
        assert synced == [file.stat().st_ino for file in files]

    @pytest.mark.parametrize("most", [1_000, 12_000], ids=["trajectories", "outcomes"])
    def test_takes_back_what_it_wrote_when_the_rest_does_not_fit(self, tmp_path, most):
        with Journal.create(tmp_path / "run", {"vut": "v"}) as journal:
            journal.append([episode(0, 0, steps=2)])
            before = (tmp_path / "run" / "outcomes.jsonl").read_bytes()
            batch = [episode(index, 1, steps=2) for index in range(1, 41)]
            # Python ignores SIGXFSZ: beyond the limit a write fails as on a full disk.
            limits = resource.getrlimit(resource.RLIMIT_FSIZE)
            resource.setrlimit(resource.RLIMIT_FSIZE, (most, limits[1]))
            try:
                with pytest.raises(UserError) as error:
                    journal.append(batch)
            finally:
                resource.setrlimit(resource.RLIMIT_FSIZE, limits)
            assert_sentence(error, "cannot write", "File too large", "--resume")
            written = (tmp_path / "run" / "trajectories" / "00001.npz").stat().st_size
            assert (written < most) == (most == 12_000), "the outcomes are the larger file"
            assert (tmp_path / "run" / "outcomes.jsonl").read_bytes() == before
            journal.append(batch)
        assert len(RecordedCampaign(tmp_path / "run").outcomes) == 41


class TestARun:
    @pytest.fixture
    def folder(self, tmp_path):
        journal = Journal.create(tmp_path / "run", {"vut": "v", "levels": [0]})
        journal.append([episode(0), episode(1)])
        journal.append([episode(2, 1)])
        return tmp_path / "run"

    def test_scores_its_trajectories_as_it_scored_them_when_they_ran(self, run):
        assert len(run.outcomes) == 60
        lines = centre_lines(road_for(US23))
        for outcome in run.outcomes:
            assert Measures.of(run.trajectory(outcome.index), lines) == outcome.measures

    def test_without_one_of_its_files_says_so(self, folder):
        (folder / "trajectories" / "00001.npz").unlink()
        run = RecordedCampaign(folder)
        assert len(run.trajectory(0).motion) == 61
        with pytest.raises(UserError, match=r"00001\.npz"):
            run.trajectory(2)
        for name in ("outcomes.jsonl", "campaign.json"):
            (folder / name).unlink()
            with pytest.raises(UserError, match=f"not a run folder.*{name}"):
                RecordedCampaign(folder)

    def test_runs_no_code_that_hides_in_trajectories(self, folder):
        path = folder / "trajectories" / "00000.npz"
        hidden = np.array([Path(folder)], dtype=object)  # which is read by unpickling alone
        np.savez(path, index=np.array([0, 1]), rows=np.array([1, 1]), motion=hidden)
        with pytest.raises(UserError, match=r"00000\.npz"):
            RecordedCampaign(folder).trajectory(0)
