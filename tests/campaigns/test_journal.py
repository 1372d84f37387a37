"""What a campaign remembers survives exactly, and what cannot be read is named."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import math
import os
import resource
from dataclasses import replace
from typing import get_type_hints

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from support.handmade import FOLLOWED_UP

from merge_sumo.campaigns.journal import Journal, to_line
from merge_sumo.campaigns.run import FILES, OUTCOMES, Run, read_outcomes, read_settings
from merge_sumo.errors import UserError
from merge_sumo.metrics.measures import OURS, Measures
from merge_sumo.metrics.merge import Severity
from merge_sumo.metrics.outcome import Episode, Outcome
from merge_sumo.road.merge import centre_lines, road_for
from merge_sumo.scenario.case import Case
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End, Trajectory

SPEC_FIELDS = [
    *("index", "batch", "level", "x_pov0_m", "v_pov0_mps", "v_vut0_mps", "svo_rad", "end"),
    *("score", "dx_m", "dv_mps", "ttc_s", "pet_s", "t_end_s"),
]
"""The record of SPEC 10 up to its dots; "error" closes it."""

examples = settings(max_examples=50, deadline=None)
number = st.floats(allow_nan=False, allow_infinity=False)
maybe = st.none() | number


@st.composite
def cases(draw) -> Case:
    level = draw(st.sampled_from([0, 1, 2]))
    svo = st.floats(0.0, math.nextafter(math.pi / 2, 0.0)) if level == 2 else st.none()
    return Case(
        level=level,
        x_pov0_m=draw(st.floats(-900.0, 0.0)),
        v_pov0_mps=draw(st.floats(0.0, 45.0)),
        svo_rad=draw(svo),
        v_vut0_mps=draw(st.floats(0.0, 45.0)),
        scenario=US23,
    )


EVERYWHERE = [name for name, one in OURS.items() if not one.only_with]
MAYBE = [n for n in EVERYWHERE if get_type_hints(OURS[n].of)["return"] == float | None]
any_measures = st.builds(
    Measures,
    **dict.fromkeys(MAYBE, maybe),
    end=st.sampled_from(End),
    t_end_s=number,
    severity=st.sampled_from([None, *(s.value for s in Severity)]),
    vut_max_brake_mps2=number,
    pov_max_brake_mps2=number,
    merged_first=st.sampled_from([None, "VUT", "POV"]),
    avoidable=st.none() | st.booleans(),
    clipped_steps=st.integers(0, 300),
    error=st.none() | st.text(),
)
any_outcome = st.builds(
    Outcome,
    index=st.integers(0, 10**6),
    batch=st.integers(0, 10**5),
    case=cases(),
    measures=any_measures,
)


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
    @examples
    @given(any_outcome)
    def test_survives_to_the_last_bit(self, outcome):
        assert Outcome.from_json(json.dumps(outcome.to_record()), scenario=US23) == outcome
        line = to_line(outcome)
        again = Outcome.from_json(line, scenario=US23)
        assert again == outcome
        assert to_line(again) == line, "repr tells floats apart that == does not: -0.0 and 0.0"

    def test_has_the_fields_of_the_specification_in_their_order(self):
        names = [n for n in episode(0).outcome.to_record() if n in (*SPEC_FIELDS, *OURS)]
        assert names[: len(SPEC_FIELDS)] == SPEC_FIELDS
        assert names[-len(FOLLOWED_UP) :] == list(FOLLOWED_UP)


class TestReading:
    def test_drops_a_last_line_that_is_torn_at_any_byte(self):
        whole, last = b"".join(lines_of(2)), lines_of(3)[2]
        before = [episode(0).outcome, episode(1).outcome]
        for cut in range(1, len(last)):
            assert read_outcomes(whole + last[:cut], "outcomes.jsonl", scenario=US23) == (
                before,
                True,
            )
        assert len(read_outcomes(whole + last, "outcomes.jsonl", scenario=US23)[0]) == 3

    @pytest.mark.parametrize(
        ("order", "line"),
        [([1, 0, 2], 1), ([0, 2, 1], 2), ([0, 0, 1], 2), ([0, 2], 2), ([0, 1, 1], 3)],
    )
    def test_names_the_first_line_that_is_not_in_its_place(self, order, line):
        lines = lines_of(3)
        with pytest.raises(UserError) as error:
            read_outcomes(
                b"".join(lines[index] for index in order), "outcomes.jsonl", scenario=US23
            )
        assert_sentence(error, f"line {line} ")

    @pytest.mark.parametrize(
        ("field", "value"),
        [
            ("index", True),
            ("batch", None),
            ("level", 4),
            ("x_pov0_m", "-200"),
            ("v_vut0_mps", None),
            ("svo_rad", 0.3),
            ("end", "ARRIVED"),
            ("score", math.nan),
            ("dx_m", "near"),
            ("clipped_steps", 1.5),
        ],
    )
    def test_refuses_a_value_of_the_wrong_type(self, field, value):
        record = {**episode(0).outcome.to_record(), field: value}
        with pytest.raises(UserError) as error:
            read_outcomes(json.dumps(record).encode() + b"\n", "outcomes.jsonl", scenario=US23)
        assert_sentence(error, "line 1")


def test_a_run_with_measures_of_an_absent_package_names_the_package(tmp_path):
    settings = {"vut": "design1", "levels": [0], "versions": {"python": "3.11", "speedy": "1.0"}}
    journal = Journal.create(tmp_path / "run", settings)
    journal.append([episode(0)])
    Run(tmp_path / "run")
    path = tmp_path / "run" / OUTCOMES
    path.write_bytes(path.read_bytes().replace(b'"error"', b'"mean_speed_mps": 1.0, "error"'))
    with pytest.raises(UserError, match=r"with speedy 1\.0, which is not installed"):
        Run(tmp_path / "run")


class TestAJournal:
    def test_gives_back_settings_outcomes_and_trajectories_to_the_last_bit(self, tmp_path):
        settings = {"vut": "design1", "levels": [0], "seed": 3, "tolerated": 0.1 + 0.2}
        journal = Journal.create(tmp_path / "run", settings)
        ran = [episode(index, batch=index // 2, steps=20 + 7 * index) for index in range(5)]
        for batch in range(3):
            journal.append([one for one in ran if one.outcome.batch == batch])
        run = Run(tmp_path / "run")
        assert run.record == settings
        assert run.outcomes == [one.outcome for one in ran]
        for index in (4, 0, 3, 1, 2):
            again = run.trajectory(index)
            assert again.motion.dtype == np.float64
            assert again.motion.shape == ran[index].trajectory.motion.shape
            assert again.motion.tobytes() == ran[index].trajectory.motion.tobytes()
            assert again.case == ran[index].trajectory.case

    def test_notes_files_and_cases_that_ran_again(self, tmp_path):
        with Journal.create(tmp_path / "run", {"vut_files": {"a": "1"}, "pov_files": None}) as to:
            to.append([replace(episode(0), files={"a": "2", "b": "3"}, again=True)])
            to.append([replace(episode(1, 1), pov_files={"c": "4"})])
        noted = {"vut_files": {"a": "1", "b": "3"}, "pov_files": {"c": "4"}, "ran_again": 1}
        assert read_settings(tmp_path / "run") == noted

    def test_notes_in_how_many_cases_a_command_was_in_vain(self, tmp_path):
        with Journal.create(tmp_path / "run", dict.fromkeys(FILES)) as to:
            for number, commands in enumerate([("a", "b"), (), ("a",)]):
                one = episode(number, number)
                trajectory = replace(one.trajectory, in_vain=commands)
                to.append([replace(one, trajectory=trajectory)])
        assert read_settings(tmp_path / "run") == {
            **dict.fromkeys(FILES),
            "in_vain": {"a": 2, "b": 1},
        }

    def test_syncs_the_trajectories_before_the_outcomes(self, tmp_path, monkeypatch):
        journal = Journal.create(tmp_path / "run", {})
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
        with Journal.create(tmp_path / "run", {}) as journal:
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
        assert len(Run(tmp_path / "run").outcomes) == 41


class TestARun:
    @pytest.fixture
    def folder(self, tmp_path):
        journal = Journal.create(tmp_path / "run", {"levels": [0]})
        journal.append([episode(0), episode(1)])
        journal.append([episode(2, 1)])
        return tmp_path / "run"

    def test_scores_its_trajectories_as_it_scored_them_when_they_ran(self, run):
        assert len(run.outcomes) == 60
        lines = centre_lines(road_for(US23))
        for outcome in run.outcomes:
            assert Measures.of(run.trajectory(outcome.index), lines) == outcome.measures

    @pytest.mark.parametrize("name", ["campaign.json", "outcomes.jsonl"])
    def test_without_one_of_its_files_is_no_campaign(self, folder, name):
        (folder / name).unlink()
        with pytest.raises(UserError) as error:
            Run(folder)
        assert_sentence(error, "not a campaign", name)

    def test_says_when_the_trajectories_of_a_case_are_missing(self, folder):
        (folder / "trajectories" / "00001.npz").unlink()
        run = Run(folder)
        assert len(run.trajectory(0).motion) == 61
        with pytest.raises(UserError) as error:
            run.trajectory(2)
        assert_sentence(error, "00001.npz")

    def test_runs_no_code_that_hides_in_trajectories(self, folder):
        class Trap:
            def __reduce__(self):
                return (os.mkdir, (str(folder / "trapped"),))

        hidden = np.array([Trap()], dtype=object)
        path = folder / "trajectories" / "00000.npz"
        np.savez(path, index=np.array([0, 1]), rows=np.array([1, 1]), motion=hidden)
        with pytest.raises(UserError) as error:
            Run(folder).trajectory(0)
        assert_sentence(error, "00000.npz")
        assert not (folder / "trapped").exists()
