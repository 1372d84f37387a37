"""What installs the package where nothing is: containers, CI and pages name the same packages."""

from __future__ import annotations

import json
import re

import pytest
import yaml
from docs_pages import ROOT

from merge_sumo.sumo.binding import DEBIAN_PACKAGES

INSTALLERS = (
    *("Dockerfile", ".devcontainer/devcontainer.json", ".ci/run", "README.md"),
    *("docs/index.md", "docs/tutorials/ci.md"),
)


@pytest.mark.parametrize("name", INSTALLERS)
def test_installs_the_libraries_that_sumo_loads(name):
    text = (ROOT / name).read_text(encoding="utf-8")
    lists = re.findall(r"libgl1 [a-z0-9 -]+", text)
    assert lists
    assert all(packages.startswith(DEBIAN_PACKAGES) for packages in lists)


def test_the_container_runs_the_first_campaign_and_not_as_root():
    lines = (ROOT / "Dockerfile").read_text(encoding="utf-8").splitlines()
    steps = dict(line.split(" ", 1) for line in lines if re.match(r"[A-Z]+ ", line))
    assert steps["USER"] != "root"
    command = [*json.loads(steps["ENTRYPOINT"]), *json.loads(steps["CMD"])]
    assert f"&& {' '.join(command)}\n" in (ROOT / "README.md").read_text(encoding="utf-8")


def test_the_devcontainer_installs_and_runs_it():
    text = (ROOT / ".devcontainer/devcontainer.json").read_text(encoding="utf-8")
    command = json.loads(text)["postCreateCommand"]
    assert command.endswith(" && merge-sumo campaign --vut design2")


def test_the_workflow_calls_what_decides_elsewhere_too():
    text = (ROOT / ".github/workflows/ci.yml").read_text(encoding="utf-8")
    steps = yaml.safe_load(text)["jobs"]["run"]["steps"]
    assert steps[-1] == {"run": ".ci/run"}
