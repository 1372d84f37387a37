"""The CI of a controller as the page shows it; `.ci/run` runs its commands as they stand."""

from __future__ import annotations

import pytest
from ci_snippets import PAGE, commands

TEXT = PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", ["github", "gitlab"])
def test_a_workflow_installs_runs_a_campaign_with_gates_and_the_test(kind):
    install, campaign, test = commands(kind, TEXT)
    assert install.startswith("pip install merge-sumo")
    assert campaign.startswith("merge-sumo campaign --vut controller.py:Controller")
    assert "--gate failures" in campaign
    assert test == "python -m pytest test_controller.py"
