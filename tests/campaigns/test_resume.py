"""A campaign that was stopped, however it was, goes on as if it had not been."""

# mypy: no-strict-optional

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path

import pytest
from support.calling import contents
from support.campaigning import campaign_settings, resume_campaign, run_campaign

from merge_sumo import interrupt
from merge_sumo.campaigns.journal import Journal
from merge_sumo.campaigns.recorded import OUTCOMES, SETTINGS, TRAJECTORIES, RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import Notice, UserError
from merge_sumo.interrupt import Interrupt, Stopped

BATCH = 8


def settings(sampler: str = "annealing", **changes) -> CampaignSettings:
    values = {"vut": "design1", "cases": 28, "batch": BATCH, "seed": 2}
    return campaign_settings(sampler=sampler, **{**values, **changes})


class StopAfter:
    """A callback that stops a campaign after some batches."""

    def __init__(self, batches: int) -> None:
        self.left = batches

    def __call__(self, _) -> None:
        self.left -= 1
        if self.left == 0:
            raise Stopped(signal.SIGINT)


def stopped_after(batches: int, folder: Path, sampler: str = "annealing") -> Path:
    with pytest.raises(Stopped):
        run_campaign(settings(sampler), folder, callbacks=[StopAfter(batches)])
    return folder


def outcomes(folder: Path) -> bytes:
    return (folder / OUTCOMES).read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory) -> Path:
    """Return the folder of a campaign that nobody disturbed."""
    return run_campaign(settings(), tmp_path_factory.mktemp("whole") / "run").folder


@pytest.fixture(scope="module")
def two_batches(tmp_path_factory) -> Path:
    return stopped_after(2, tmp_path_factory.mktemp("stopped") / "run")


@pytest.fixture
def folder(two_batches, tmp_path) -> Path:
    """Return a copy of a campaign that was stopped after two batches of four."""
    return Path(shutil.copytree(two_batches, tmp_path / "run"))


class TestResuming:
    def test_gives_the_same_bytes_and_files(self, whole, folder):
        assert outcomes(whole).startswith(outcomes(folder))
        assert len(RecordedCampaign(folder).outcomes) == 2 * BATCH
        run = resume_campaign(folder)
        assert outcomes(folder) == outcomes(whole)
        assert len(run.outcomes) == 28
        names = {path.relative_to(folder) for path in folder.rglob("*")}
        assert names == {path.relative_to(whole) for path in whole.rglob("*")}
        assert (folder / SETTINGS).read_bytes() == (whole / SETTINGS).read_bytes()
        assert (
            run.trajectory(27).motion.tobytes()
            == RecordedCampaign(whole).trajectory(27).motion.tobytes()
        )

    @pytest.mark.parametrize("kept", ["all but a byte", "15 lines", "4 lines", "no motion"])
    def test_drops_what_was_not_written_to_its_end_and_says_so(self, whole, folder, kept):
        text = outcomes(folder)
        if kept == "no motion":
            (folder / TRAJECTORIES / "00001.npz").unlink()
        elif kept == "all but a byte":
            (folder / OUTCOMES).write_bytes(text[:-1])
        else:
            lines = text.splitlines(keepends=True)[: int(kept.split()[0])]
            (folder / OUTCOMES).write_bytes(b"".join(lines))
        with pytest.warns(Notice, match="dropped"):
            resume_campaign(folder)
        assert outcomes(folder) == outcomes(whole)


class TestWhatDiffers:
    @pytest.mark.parametrize(
        ("given", "name"),
        [
            ({"seed": 3}, "seed differs: .* ran with 2, now it is 3; set it as before, or start"),
            ({"fail_when": "contact"}, "fail_when differs"),
            ({"levels": (1,)}, "levels differs"),
            ({"cases": 24}, "cases differs: .* with 28, now it is 24; give 28 or more, or start"),
        ],
    )
    def test_of_the_settings_is_refused_by_name(self, folder, given, name):
        before = contents(folder)
        with pytest.raises(UserError, match=name):
            resume_campaign(folder, given=given)
        assert contents(folder) == before

    @pytest.mark.parametrize(
        "where", [("versions", "numpy"), ("net_sha256",), ("policies_sha256", "pov1")]
    )
    def test_of_software_net_and_policies_is_refused_by_name(self, folder, where):
        edit(folder, where, "another")
        before = contents(folder)
        with pytest.raises(UserError, match=rf"{'.'.join(where)} differs"):
            resume_campaign(folder)
        assert contents(folder) == before

    def test_may_be_a_larger_number_of_cases(self, whole, tmp_path):
        longer = Path(shutil.copytree(whole, tmp_path / "run"))
        run = resume_campaign(longer, given={"cases": 36})
        assert len(run.outcomes) == 36
        assert outcomes(longer).startswith(outcomes(whole))
        assert [outcome.batch for outcome in run.outcomes][-9:] == [3] + [4] * 8


def edit(folder: Path, where: tuple[str, ...], value) -> None:
    """Change a value of campaign.json, as a user may."""
    record = json.loads((folder / SETTINGS).read_text())
    inner = record
    for key in where[:-1]:
        inner = inner[key]
    inner[where[-1]] = value
    (folder / SETTINGS).write_text(json.dumps(record))


class TestTwoProcessesOnOneFolder:
    def test_are_one_too_many(self, folder):
        journal, _, _ = Journal.reopen(folder)
        before = contents(folder)
        with journal, pytest.raises(UserError, match="another process is writing"):
            resume_campaign(folder)
        assert contents(folder) == before
        resume_campaign(folder)


class TestASignal:
    def test_is_noted_in_this_process_and_the_second_one_raises(self, monkeypatch):
        before = signal.getsignal(signal.SIGINT)
        said: list = []
        monkeypatch.setattr(os, "write", lambda file, text: said.append((file, text)))
        with Interrupt("wait") as stop:
            stop.check()
            signal.raise_signal(signal.SIGTERM)
            with pytest.raises(Stopped) as stopped:
                stop.check()
            assert stopped.value.exit_code == 143
            with pytest.raises(Stopped) as stopped:
                signal.raise_signal(signal.SIGINT)
            assert stopped.value.exit_code == 130
        assert said == [(interrupt.STDERR, b"\nwait\n")]
        assert signal.getsignal(signal.SIGINT) is before
