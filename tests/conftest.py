"""Fixtures for all tests: real SUMO worlds and finished campaigns."""

from __future__ import annotations

import os
import shutil
import subprocess

import pytest

from merge_sumo.campaigns.conductor import run_campaign
from merge_sumo.campaigns.run import Run
from merge_sumo.campaigns.settings import CampaignSettings

MOUNT, UMOUNT = shutil.which("mount"), shutil.which("umount")


def require(available: bool, reason: str) -> None:
    """Skip with a reason where something is absent; fail instead when CI=true."""
    if available:
        return
    if os.environ.get("CI") == "true":
        pytest.fail(f"CI must have it: {reason}")
    pytest.skip(reason)


@pytest.fixture(scope="session")
def run(tmp_path_factory) -> Run:
    """Return a small finished campaign with failures: design1 against level 0."""
    settings = CampaignSettings(vut="design1", levels=(0,), cases=60, batch=20, seed=1)
    return run_campaign(settings, tmp_path_factory.mktemp("campaign") / "run")


@pytest.fixture
def small_disk(tmp_path):
    """Mount a file system of 256 kB."""
    require(os.geteuid() == 0 and MOUNT is not None, "mounting needs root")
    disk = tmp_path / "disk"
    disk.mkdir()
    done = subprocess.run(
        [MOUNT, "-t", "tmpfs", "-o", "size=256k", "tmpfs", str(disk)],
        capture_output=True,
        check=False,
    )
    require(done.returncode == 0, f"mount: {done.stderr.decode().strip()}")
    yield disk
    subprocess.run([UMOUNT, "--lazy", str(disk)], check=True)
