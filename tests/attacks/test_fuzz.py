"""Whatever the bytes of a file, its reader gives a value or one sentence.

Every reader of files of others gets a file that merge-sumo wrote with a few bytes changed, and any
bytes at all. A `UserError` of one line is the only exception allowed.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from support.campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.journal import to_line
from merge_sumo.campaigns.run import (
    OUTCOMES,
    SETTINGS,
    TRAJECTORIES,
    Run,
    read_outcomes,
)
from merge_sumo.campaigns.settings import settings_of
from merge_sumo.drivers.policies import load_network, read_manifest
from merge_sumo.errors import UserError
from merge_sumo.files import resource
from merge_sumo.reports.report import write_report
from merge_sumo.road.merge import default_net_path, road_of
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo import replay
from merge_sumo.sumo.hosting import hosted_net
from merge_sumo.sumo.replay_folder import CASE, RECORD

HARSH = [
    *(b"null", b"NaN", b"-Infinity", b"1e999", b"true", b"[]", b"{}", b'"\\ud800"', b"-0", b"\n"),
    *(
        b"[" * 100_000,
        b'{"a":' * 100_000,
        b"9" * 5000,
        b"\xff\xfe",
        b"\x00",
        b"</",
        b"&x;",
        b"<!--",
    ),
]


@st.composite
def spoilt(draw: Any, original: bytes) -> bytes:
    """Return bytes with a few places replaced, removed, doubled, or cut off; or any bytes."""
    if draw(st.integers(0, 9)) == 0:
        return bytes(draw(st.binary(max_size=200)))
    text = bytearray(original)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, min(len(text), 3000)) | st.integers(0, len(text)))
        length = draw(st.integers(0, 12))
        kind = draw(st.sampled_from(["replace", "insert", "double", "cut"]))
        if kind == "cut":
            del text[at:]
        elif kind == "double":
            text[at:at] = text[at : at + 40 * length]
        else:
            end = at + (length if kind == "replace" else 0)
            text[at:end] = draw(st.binary(max_size=12) | st.sampled_from(HARSH))
    return bytes(text)


def read_campaign(path: Path) -> None:
    run = Run(path.parents[path.parent.name == TRAJECTORIES])
    for read in (
        lambda: settings_of(run.folder, run.record),
        lambda: write_report(run),
        lambda: run.trajectory(0),
    ):
        with suppress(UserError):
            read()


def read_lines(path: Path) -> None:
    outcomes, _ = read_outcomes(path.read_bytes(), OUTCOMES, scenario=US23)
    again = "".join(map(to_line, outcomes)).encode()
    assert read_outcomes(again, OUTCOMES, scenario=US23) == (outcomes, False)


def read_policies(path: Path) -> None:
    read_manifest(path.parent)
    load_network("pov1", path.parent)


def read_tensors(path: Path) -> None:
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    manifest = {"networks": {"pov1": {"sha256": sha256}}}
    (path.parent / "manifest.json").write_text(json.dumps(manifest))
    load_network("pov1", path.parent)


def read_net(path: Path) -> None:
    hosted_net(road_of(path), 2)


READERS: dict[str, tuple[str, Callable[[Path], object]]] = {
    "the settings of a campaign": (f"run/{SETTINGS}", read_campaign),
    "the outcomes of a campaign": (f"run/{OUTCOMES}", read_campaign),
    "the motion of a campaign": (f"run/{TRAJECTORIES}/00000.npz", read_campaign),
    "lines of outcomes": (f"run/{OUTCOMES}", read_lines),
    "the list of policies": ("policies/manifest.json", read_policies),
    "the weights of a policy": ("policies/pov1.safetensors", read_tensors),
    "the record of a replay": (f"replay/{RECORD}", lambda path: replay._read(path.parent)),
    "the case of a replay": (f"replay/{CASE}", lambda path: replay._read(path.parent)),
    "a net": ("net/us23.net.xml", read_net),
}
"""File, and what reads it."""


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of files that merge-sumo wrote."""
    folder = tmp_path_factory.mktemp("written")
    settings = campaign_settings(vut="design1", sampler="uniform", cases=60, seed=4)
    run_campaign(settings, folder / "run")
    shutil.copytree(next((folder / "run" / "scenarios").iterdir()), folder / "replay")
    shutil.copytree(resource("policies"), folder / "policies")
    (folder / "net").mkdir()
    shutil.copy(default_net_path(), folder / "net")
    return folder


here = settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@pytest.mark.parametrize("name", READERS)
@here
@given(data=st.data())
def test_a_spoilt_file_is_a_value_or_a_sentence(written: Path, name: str, data: Any) -> None:
    file, reader = READERS[name]
    path = written / file
    manifest = written / "policies" / "manifest.json"
    before, manifest_before = path.read_bytes(), manifest.read_bytes()
    whole = before if name != "lines of outcomes" else b"".join(before.splitlines(True)[:4])
    path.write_bytes(data.draw(spoilt(whole)))
    try:
        with suppress(UserError):
            reader(path)
    finally:
        manifest.write_bytes(manifest_before)
        path.write_bytes(before)
