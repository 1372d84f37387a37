"""Learned drivers of the user: `--policies DIR`."""

from __future__ import annotations

import hashlib
import json
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy
from numpy.typing import NDArray
from support.calling import assert_refused
from support.campaigning import campaign_settings, run_campaign
from support.plans import plan_for

from merge_sumo.campaigns.recorded import OUTCOMES, RecordedCampaign
from merge_sumo.drivers.levelk import ACTIONS, FEATURES
from merge_sumo.drivers.policies import MANIFEST, MOST_BYTES, policies_in, policies_of
from merge_sumo.errors import UserError
from merge_sumo.scenario.scenario import US23
from merge_sumo.scenario.trajectory import End
from merge_sumo.simulation.evaluate import open_simulators
from merge_sumo.simulation.povs import Povs
from merge_sumo.workers import open_workers

SHIPPED = policies_of(US23)


@pytest.fixture
def folder(tmp_path) -> Path:
    """Return a folder with the shipped policies."""
    return Path(shutil.copytree(SHIPPED, tmp_path / "policies"))


def write_network(folder: Path, name: str, tensors: dict[str, NDArray[Any]]) -> None:
    """Write a network into a folder, with its hash in the manifest."""
    single = {name: a.astype(np.float32) if a.dtype == float else a for name, a in tensors.items()}
    content = safetensors.numpy.save(single)
    (folder / f"{name}.safetensors").write_bytes(content)
    manifest = json.loads((folder / MANIFEST).read_text())
    manifest["networks"][name]["sha256"] = hashlib.sha256(content).hexdigest()
    (folder / MANIFEST).write_text(json.dumps(manifest))


def campaign(policies: Path | None, out: Path, vut: str = "design2") -> RecordedCampaign:
    named = None if policies is None else str(policies)
    small: dict[str, Any] = {"levels": (1,), "cases": 24, "batch": 8, "seed": 2}
    asked = campaign_settings(vut=vut, policies=named, sampler="uniform", **small)
    return run_campaign(asked, out)


def test_a_campaign_drives_with_the_named_policies_and_records_them(folder, tmp_path):
    shipped = campaign(None, tmp_path / "shipped")
    same = campaign(folder, tmp_path / "same")
    pov = safetensors.numpy.load_file(SHIPPED / "pov1.safetensors")
    write_network(folder, "pov1", safetensors.numpy.load_file(SHIPPED / "vut1.safetensors"))
    write_network(folder, "vut1", pov)
    swapped = campaign(folder, tmp_path / "swapped")
    recorded = [(run.folder / OUTCOMES).read_bytes() for run in (shipped, same, swapped)]
    assert recorded[0] == recorded[1] != recorded[2]
    assert shipped.record["policies"] is None
    assert swapped.record["policies"] == str(folder)
    hashes, before = swapped.record["policies_sha256"], same.record["policies_sha256"]
    assert (hashes["pov1"], hashes["vut1"]) == (before["vut1"], before["pov1"])


@pytest.mark.parametrize("command", [("campaign", "--vut", "design1"), ("reproduce", "--quick")])
def test_commands_refuse_anything_but_a_folder_of_policies(call, command, tmp_path):
    (tmp_path / "file").touch()
    (tmp_path / "empty").mkdir()
    before = sorted(tmp_path.iterdir())
    for named in ("nowhere", "file", "empty", "/dev/null"):
        assert_refused(call(*command, "--policies", named), "choose a folder that")
    assert sorted(tmp_path.iterdir()) == before


def test_a_shipped_library_is_named_and_a_folder_of_its_name_by_a_path(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shutil.copytree(SHIPPED, tmp_path / "roundabout")
    assert policies_in("roundabout") != tmp_path / "roundabout"
    assert policies_in("./roundabout") == tmp_path / "roundabout"


class TestAFolder:
    @pytest.mark.parametrize(
        ("what", "sentence"),
        [
            ("gone", ""),
            ("another", ""),
            ("a pipe", "it is not a file"),
            ("a giant", f"it is larger than {MOST_BYTES // 2**20} MiB"),
        ],
    )
    def test_with_another_network_than_in_its_manifest_is_refused(
        self, folder, tmp_path, what, sentence
    ):
        network = folder / "pov1.safetensors"
        network.unlink()
        if what == "another":
            network.write_bytes((folder / "pov2.safetensors").read_bytes())
        elif what == "a pipe":
            os.mkfifo(network)
        elif what == "a giant":
            with network.open("wb") as file:
                file.truncate(MOST_BYTES + 1)
        with pytest.raises(UserError, match=rf"pov1\.safetensors.*{sentence}"):
            campaign(folder, tmp_path / "run")
        assert not (tmp_path / "run").exists()

    @pytest.mark.parametrize(
        ("changed", "said"),
        [
            ({"0.bias": np.zeros(1)}, "0.bias is (1,)"),
            ({"1.weight": np.zeros((ACTIONS, 9))}, "1.weight is (7, 9)"),
            ({"0.weight": np.zeros((8, FEATURES), dtype=np.int64)}, "of int64"),
            ({"a_min_mps2": np.zeros((2, 2))}, "can only convert an array of size 1"),
            ({"a_min_mps2": np.zeros(1)}, "its braking limit is not from -20 to below 0"),
            ({"2.weight": np.zeros((7, 7))}, "instead of 0.weight, 0.bias, ..."),
            ({"0.weight": np.zeros((8, 3), np.float32)}, "(outputs, 26) and (outputs,)"),
        ],
    )
    def test_with_wrong_tensors_is_refused(self, call, folder, tmp_path, changed, said):
        tensors = {
            "0.weight": np.zeros((8, FEATURES)),
            "0.bias": np.zeros(8),
            "1.weight": np.zeros((ACTIONS, 8)),
            "1.bias": np.zeros(ACTIONS),
        }
        write_network(folder, "vut1", tensors | changed)
        asked = ("--vut", "level1", "--level", "1", "--cases", 4, "--policies", folder)
        result = call("campaign", *asked, "--out", tmp_path / "run")
        assert_refused(result, "vut1.safetensors is not an action-value network: ", said)
        assert not (tmp_path / "run").exists()

    @pytest.mark.parametrize(("name", "end"), [("pov1", End.SIM_ERROR), ("vut1", End.VUT_ERROR)])
    def test_with_action_values_that_are_not_finite_gives_errors(self, folder, tmp_path, name, end):
        weights = [np.outer([1.0, -1.0], np.ones(FEATURES)), *[np.full((2, 2), 1e38)] * 9]
        tensors: dict[str, NDArray[Any]] = {}
        for i, weight in enumerate([*weights, np.full((ACTIONS, 2), 1e38)]):
            tensors |= {f"{i}.weight": weight, f"{i}.bias": np.zeros(len(weight))}
        write_network(folder, name, tensors)
        ran = campaign(folder, tmp_path / "run", "level1" if name == "vut1" else "design2")
        assert {outcome.measures.end for outcome in ran.outcomes} == {end}
        assert {outcome.margin for outcome in ran.outcomes} == {None}
        assert "action values that are not finite" in str(ran.outcomes[0].measures.error)

    def test_that_a_worker_does_not_have_is_said_in_a_sentence(self, folder):
        plan = plan_for("design1", corridors=2, povs=Povs(policies=folder))
        shutil.rmtree(folder)
        with open_workers(1) as workers, pytest.raises(UserError, match="copy the files of this"):
            open_simulators(plan, workers)
