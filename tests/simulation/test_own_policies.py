"""Learned drivers of the user: `--policies DIR`."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from numpy.typing import NDArray
from support.calling import assert_refused
from support.campaigning import campaign_settings, run_campaign
from support.plans import plan_for

from merge_sumo.campaigns.run import OUTCOMES
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.drivers.levelk import ACTIONS, FEATURES
from merge_sumo.drivers.policies import MANIFEST, MOST_BYTES, policies_in, policies_of
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.simulation.evaluate import open_simulators
from merge_sumo.simulation.povs import Povs
from merge_sumo.workers import open_workers

SMALL: dict[str, Any] = {"levels": (1,), "cases": 24, "batch": 8, "seed": 2, "sampler": "uniform"}


@pytest.fixture(scope="module")
def home(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("policies")


@pytest.fixture(scope="module")
def same(home) -> Path:
    """Return a folder with the shipped policies."""
    return Path(shutil.copytree(policies_of(scenario=US23), home / "same"))


@pytest.fixture(scope="module")
def swapped(home) -> Path:
    """Return a folder in which the POV of level 1 is the shipped VUT, and the other way round."""
    folder = Path(shutil.copytree(policies_of(scenario=US23), home / "swapped"))
    one, other = folder / "pov1.safetensors", folder / "vut1.safetensors"
    first, second = one.read_bytes(), other.read_bytes()
    one.write_bytes(second)
    other.write_bytes(first)
    known = networks(folder)
    known["pov1"], known["vut1"] = known["vut1"], known["pov1"]
    write(folder, known)
    return folder


def networks(folder: Path) -> dict:
    return json.loads((folder / MANIFEST).read_text())["networks"]


def write(folder: Path, known: dict) -> None:
    (folder / MANIFEST).write_text(json.dumps({"networks": known}))


def outcomes(folder: Path) -> bytes:
    return (folder / OUTCOMES).read_bytes()


def with_layers(
    policies: Path, folder: Path, name: str, weights: Sequence[NDArray[np.float64]]
) -> Path:
    """Return a copy of policies in which a network has other layers, with its true hash."""
    shutil.copytree(policies, folder)
    path = folder / f"{name}.safetensors"
    tensors = {f"{i}.weight": weight for i, weight in enumerate(weights)}
    biases = {f"{i}.bias": np.zeros(len(weight)) for i, weight in enumerate(weights)}
    safetensors.numpy.save_file(tensors | biases, path)
    write(folder, with_hash(networks(folder), path))
    return folder


def with_hash(known: dict, path: Path) -> dict:
    """Return a manifest's networks in which one has the hash of its file."""
    sha256 = hashlib.sha256(path.read_bytes()).hexdigest()
    return {**known, path.stem: {**known[path.stem], "sha256": sha256}}


def settings(policies: Path | None, **changes) -> CampaignSettings:
    named = None if policies is None else str(policies)
    return campaign_settings(vut="design2", policies=named, **{**SMALL, **changes})


class TestACampaign:
    def test_drives_with_the_policies_that_it_is_given(self, same, swapped, tmp_path):
        for name, folder in (("shipped", None), ("same", same), ("swapped", swapped)):
            run_campaign(settings(folder), tmp_path / name)
        assert outcomes(tmp_path / "same") == outcomes(tmp_path / "shipped")
        assert outcomes(tmp_path / "swapped") != outcomes(tmp_path / "shipped")

    def test_records_where_they_were_and_their_hashes(self, swapped, tmp_path):
        recorded = run_campaign(settings(swapped), tmp_path / "run").record
        assert recorded["policies"] == str(swapped)
        hashes = {name: entry["sha256"] for name, entry in networks(swapped).items()}
        assert recorded["policies_sha256"] == hashes
        assert run_campaign(settings(None), tmp_path / "shipped").record["policies"] is None


@pytest.mark.parametrize("command", [("campaign", "--vut", "design1"), ("reproduce", "--quick")])
def test_commands_refuse_anything_but_a_folder_of_policies(call, command, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    before = sorted(tmp_path.iterdir())
    for named in ("nowhere", "file", "empty", "/dev/null"):
        assert_refused(call(*command, "--policies", named), "name a folder of policies")
    assert sorted(tmp_path.iterdir()) == before


def test_a_shipped_library_is_not_confused_with_a_folder_of_its_name(same, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(same, tmp_path / "roundabout")
    with pytest.raises(UserError, match="a shipped library and a folder here"):
        policies_in("roundabout")
    assert policies_in(tmp_path / "roundabout") == tmp_path / "roundabout"


class TestAFolder:
    @pytest.mark.parametrize(
        ("what", "sentence"),
        [
            ("gone", ""),
            ("another", ""),
            ("a pipe", "it is not a file"),
            ("a folder", "it is not a file"),
            ("a giant", f"it is larger than {MOST_BYTES // 2**20} MiB"),
        ],
    )
    def test_whose_networks_are_not_those_of_its_manifest_leaves_nothing(
        self, same, tmp_path, what, sentence
    ):
        folder = Path(shutil.copytree(same, tmp_path / "policies"))
        network = folder / "pov1.safetensors"
        network.unlink()
        if what == "another":
            network.write_bytes((folder / "pov2.safetensors").read_bytes())
        elif what == "a pipe":
            os.mkfifo(network)
        elif what == "a folder":
            network.mkdir()
        elif what == "a giant":
            with network.open("wb") as file:
                file.truncate(MOST_BYTES + 1)
        with pytest.raises(UserError, match=rf"pov1\.safetensors.*{sentence}"):
            run_campaign(settings(folder), tmp_path / "run")
        assert not (tmp_path / "run").exists()

    @pytest.mark.parametrize(
        ("changed", "said"),
        [
            ({"0.bias": np.zeros(1)}, "0.bias is (1,)"),
            ({"1.weight": np.zeros((1, ACTIONS, 8))}, "1.weight is (1, 7, 8)"),
            ({"1.weight": np.zeros((ACTIONS, 9))}, "1.weight is (7, 9)"),
            ({"0.weight": np.zeros((8, FEATURES), dtype=np.int64)}, "of int64"),
            ({"0.weight": np.zeros((0, FEATURES)), "0.bias": np.zeros(0)}, "0.weight is (0, 26)"),
            ({"a_min_mps2": np.zeros((2, 2))}, "can only convert an array of size 1"),
            ({"2.weight": np.zeros((7, 7))}, "and not 0.weight, 0.bias, ..."),
            ({"1.weight": np.full((ACTIONS, 8), 1e39)}, "a weight is NaN"),
            (None, "its tensors are [], and not 0.weight"),
        ],
    )
    def test_with_tensors_of_other_shapes_or_types_leaves_nothing(
        self, call, same, tmp_path, changed, said
    ):
        folder, path = tmp_path / "policies", tmp_path / "policies" / "vut1.safetensors"
        with_layers(same, folder, "vut1", [np.zeros((8, FEATURES)), np.zeros((ACTIONS, 8))])
        tensors = {} if changed is None else safetensors.numpy.load_file(path) | changed
        safetensors.numpy.save_file(tensors, path)
        write(folder, with_hash(networks(folder), path))
        asked = ("--vut", "level1", "--level", "1", "--cases", 4, "--policies", folder)
        result = call("campaign", *asked, "--out", tmp_path / "run")
        assert_refused(result, "vut1.safetensors holds no action-value network: ")
        assert said in result[2]
        assert not (tmp_path / "run").exists()

    @pytest.mark.parametrize(("name", "end"), [("pov1", End.SIM_ERROR), ("vut1", End.VUT_ERROR)])
    def test_whose_action_values_are_not_finite_gives_no_result(self, same, tmp_path, name, end):
        big = np.full((2, 2), 1e38)  # finite weights whose products are not
        first, last = np.outer([1.0, -1.0], np.ones(FEATURES)), np.full((ACTIONS, 2), 1e38)
        layers = [first, *[big] * 9, last]
        folder = with_layers(same, tmp_path / "policies", name, layers)
        vut = "level1" if name == "vut1" else "design2"
        asked = dataclasses.replace(settings(folder), vut=vut)
        ran = run_campaign(asked, tmp_path / "run")
        assert {outcome.measures.end for outcome in ran.outcomes} == {end}
        assert {outcome.margin for outcome in ran.outcomes} == {None}
        assert "action values that are not finite" in str(ran.outcomes[0].measures.error)

    def test_that_a_worker_does_not_have_is_said_in_a_sentence(self, same, tmp_path):
        folder = Path(shutil.copytree(same, tmp_path / "policies"))
        plan = plan_for("design1", corridors=2, povs=Povs(policies=folder))
        shutil.rmtree(folder)
        with open_workers(1) as workers, pytest.raises(UserError, match="put the same files there"):
            open_simulators(plan, workers)
