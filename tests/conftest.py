"""Fixtures for all tests: real SUMO worlds and finished campaigns."""

from __future__ import annotations

import os

import pytest

from merge_sumo.conductor import CampaignSettings, run_campaign
from merge_sumo.journal import Run


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
