"""Whatever the bytes of a file or the words of a command, the answer is a value or a sentence.

Every reader of what comes from outside is given files that it wrote itself with a few bytes
changed, and files of anything at all. A `UserError` of one line is the only exception allowed.
"""

# mypy: no-strict-optional

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pytest
from campaigning import campaign_settings, run_campaign
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from merge_sumo.campaigns.journal import to_line
from merge_sumo.campaigns.run import (
    OUTCOMES,
    SETTINGS,
    TRAJECTORIES,
    Run,
    read_outcomes,
    read_settings,
)
from merge_sumo.campaigns.settings import settings_of
from merge_sumo.drivers.policies import load_network, read_manifest
from merge_sumo.errors import UserError
from merge_sumo.reports.report import write_report
from merge_sumo.road.merge import default_net_path, road_of
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo import replay, replay_folder
from merge_sumo.sumo.hosting import hosted_net
from merge_sumo.system.resources import resource

here = settings(
    max_examples=40,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


@st.composite
def spoilt(draw, original: bytes) -> bytes:
    """Return bytes with a few places replaced, removed, doubled, or cut off."""
    text = bytearray(original)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(text)))
        length = draw(st.integers(0, 12))
        kind = draw(st.sampled_from(["replace", "insert", "double", "cut"]))
        if kind == "cut":
            del text[at:]
        elif kind == "double":
            text[at:at] = text[at : at + 40 * length]
        else:
            end = at + (length if kind == "replace" else 0)
            text[at:end] = draw(st.binary(max_size=12) | st.sampled_from(NASTY))
    return bytes(text)


NASTY = [
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

any_json = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)


T = TypeVar("T")
NPZ = f"{TRAJECTORIES}/00000.npz"


def answer(read: Callable[[], T]) -> T | None:
    """Return what a reader gives, or None where it refuses in a sentence."""
    try:
        return read()
    except UserError as error:
        sentence = str(error)
    assert sentence
    assert "\n" not in sentence
    return None


@pytest.fixture(scope="module")
def run(tmp_path_factory) -> Run:
    """Return a small campaign of which nothing was predicted: its report takes little time."""
    settings = campaign_settings(vut="design1", sampler="uniform", cases=60, seed=4)
    return run_campaign(settings, tmp_path_factory.mktemp("campaign") / "run")


@pytest.fixture(scope="module")
def lines(run) -> bytes:
    """Return the first outcomes of a campaign."""
    return b"".join((run.folder / OUTCOMES).read_bytes().splitlines(keepends=True)[:4])


@pytest.fixture(scope="module")
def folder(run, tmp_path_factory) -> Path:
    return Path(shutil.copytree(run.folder, tmp_path_factory.mktemp("fuzz") / "run"))


@pytest.fixture(scope="module")
def policies(tmp_path_factory) -> Path:
    return Path(shutil.copytree(resource("policies"), tmp_path_factory.mktemp("fuzz") / "policies"))


@pytest.fixture(scope="module")
def scenario(run, tmp_path_factory) -> Path:
    first, *_ = sorted((run.folder / "scenarios").iterdir())
    return Path(shutil.copytree(first, tmp_path_factory.mktemp("fuzz") / "scenario"))


def some(*examples: bytes) -> st.SearchStrategy[bytes]:
    """Return examples that are spoilt, and bytes of any kind."""
    return st.one_of(*map(spoilt, examples)) | st.binary(max_size=200)


class TestOutcomes:
    def read(self, text: bytes) -> None:
        found = answer(lambda: read_outcomes(text, OUTCOMES, scenario=US23))
        if found is not None:
            outcomes, _ = found
            again, torn = read_outcomes(
                "".join(map(to_line, outcomes)).encode(), OUTCOMES, scenario=US23
            )
            assert (again, torn) == (outcomes, False), "what was read can be written"

    @here
    @given(data=st.data())
    def test_of_spoilt_bytes(self, lines, data):
        self.read(data.draw(some(lines)))


class TestACampaign:
    def read(self, folder: Path) -> None:
        run = answer(lambda: Run(folder))
        if run is not None:
            answer(lambda: settings_of(folder, run.record))
            answer(lambda: write_report(run))
            answer(lambda: run.trajectory(0))

    @pytest.mark.parametrize("name", [SETTINGS, OUTCOMES, NPZ])
    @here
    @given(data=st.data())
    def test_of_a_spoilt_file(self, run, folder, lines, name, data):
        whole = {part: (run.folder / part).read_bytes() for part in (SETTINGS, NPZ)}
        whole[OUTCOMES] = lines
        for part, content in whole.items():
            (folder / part).write_bytes(content)
        (folder / name).write_bytes(data.draw(some(whole[name])))
        self.read(folder)

    @here
    @given(data=st.data())
    def test_of_a_setting_of_any_value(self, run, folder, data):
        record = read_settings(run.folder)
        record[data.draw(st.sampled_from(sorted(record)))] = data.draw(any_json)
        (folder / SETTINGS).write_text(json.dumps(record))
        self.read(folder)


class TestPolicies:
    @here
    @given(data=st.data())
    def test_with_a_spoilt_manifest(self, policies, data):
        original = (resource("policies") / "manifest.json").read_bytes()
        (policies / "manifest.json").write_bytes(data.draw(some(original)))
        if answer(lambda: read_manifest(policies)) is not None:
            answer(lambda: load_network("pov1", policies))

    @here
    @given(data=st.data())
    def test_of_spoilt_tensors_that_the_manifest_vouches_for(self, policies, data):
        original = (resource("policies") / "pov1.safetensors").read_bytes()
        header = original[:400]
        content = data.draw(spoilt(header)) + original[400:] if data.draw(st.booleans()) else None
        content = content if content is not None else data.draw(st.binary(max_size=300))
        manifest = {"networks": {"pov1": {"sha256": hashlib.sha256(content).hexdigest()}}}
        (policies / "manifest.json").write_text(json.dumps(manifest))
        (policies / "pov1.safetensors").write_bytes(content)
        answer(lambda: load_network("pov1", policies))


class TestAReplayFolder:
    @pytest.mark.parametrize("name", [replay_folder.RECORD, replay_folder.CASE])
    @here
    @given(data=st.data())
    def test_with_a_spoilt_file(self, scenario, name, data):
        whole = (scenario / name).read_bytes()
        (scenario / name).write_bytes(data.draw(some(whole[:1500], whole)))
        try:
            answer(lambda: replay._read(scenario))
        finally:
            (scenario / name).write_bytes(whole)

    @here
    @given(data=st.data())
    def test_with_a_spoilt_net(self, tmp_path, data):
        path = tmp_path / "spoilt.net.xml"
        path.write_bytes(data.draw(some(default_net_path().read_bytes())))
        road = answer(lambda: road_of(path))
        if road is not None:
            answer(lambda: hosted_net(road, 2))
            answer(lambda: road.speed_limit_mps)
