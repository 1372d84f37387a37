"""Whatever the bytes of a file, its reader gives a value or one sentence.

Every reader of files of others gets a file that merge-sumo wrote with a few bytes changed, and any
bytes at all. A `UserError` is the only exception allowed.
"""

from __future__ import annotations

import shutil
from contextlib import suppress

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from merge_sumo.campaigns.recorded import OUTCOMES, SETTINGS, TRAJECTORIES, RecordedCampaign
from merge_sumo.campaigns.settings import settings_from_folder
from merge_sumo.drivers.policies import read_manifest
from merge_sumo.errors import UserError
from merge_sumo.files import resource
from merge_sumo.reports.report import write_report
from merge_sumo.road.loader import default_net_path, road_of
from merge_sumo.sumo import replay
from merge_sumo.sumo.net_copies import hosted_net
from merge_sumo.sumo.replay_folder import CASE, RECORD

HARSH = [
    *(b"null", b"NaN", b"-Infinity", b"1e999", b"true", b"[]", b"{}", b'"\\ud800"', b"-0", b"\n"),
    *(b"[" * 100_000, b"9" * 5000, b"\xff\xfe", b"\x00", b"</", b"&x;", b"<!--"),
]


@st.composite
def spoilt(draw, original):
    """Return bytes of which a few parts are replaced, doubled or cut off; or any bytes."""
    if draw(st.integers(0, 9)) == 0:
        return bytes(draw(st.binary(max_size=200)))
    text = bytearray(original)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, min(len(text), 3000)) | st.integers(0, len(text)))
        end = draw(st.sampled_from([at + draw(st.integers(0, 12)), len(text)]))
        text[at:end] = draw(st.binary(max_size=12) | st.sampled_from([*HARSH, text[at:end] * 2]))
    return bytes(text)


def read_settings(folder):
    run = RecordedCampaign(folder)
    settings_from_folder(run.folder, run.record)


READERS = [
    ("run", SETTINGS, read_settings),
    ("run", SETTINGS, lambda folder: write_report(RecordedCampaign(folder))),
    ("run", OUTCOMES, lambda folder: write_report(RecordedCampaign(folder))),
    ("run", f"{TRAJECTORIES}/00000.npz", lambda folder: RecordedCampaign(folder).trajectory(0)),
    ("policies", "manifest.json", read_manifest),
    ("replay", RECORD, replay._read),
    ("replay", CASE, replay._read),
    ("net", default_net_path().name, lambda folder: hosted_net(road_of(next(folder.iterdir())), 2)),
]
"""Folder, file, and what reads it."""


@pytest.fixture(scope="module")
def written(run, tmp_path_factory):
    """Return a folder of files that merge-sumo wrote."""
    folder = tmp_path_factory.mktemp("written")
    shutil.copytree(run.folder, folder / "run")
    shutil.copytree(next((run.folder / "scenarios").iterdir()), folder / "replay")
    shutil.copytree(resource("policies"), folder / "policies")
    (folder / "net").mkdir()
    shutil.copy(default_net_path(), folder / "net")
    return folder


@pytest.mark.parametrize(("folder", "file", "reader"), READERS)
@settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(data=st.data())
def test_a_spoilt_file_is_a_value_or_a_sentence(written, folder, file, reader, data):
    path = written / folder / file
    before = path.read_bytes()
    path.write_bytes(data.draw(spoilt(before)))
    try:
        with suppress(UserError):
            reader(written / folder)
    finally:
        path.write_bytes(before)
