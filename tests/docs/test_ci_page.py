"""The CI of a controller as the page shows it; `.ci/run` runs its commands as they stand."""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from ci_snippets import PAGE, commands, main

TEXT = PAGE.read_text(encoding="utf-8")


@pytest.mark.parametrize("kind", ["github", "gitlab"])
def test_a_workflow_installs_runs_a_campaign_with_gates_and_the_test(kind):
    install, campaign, test = commands(kind, TEXT)
    assert install.startswith("pip install merge-sumo")
    assert campaign.startswith("merge-sumo campaign --vut controller.py:Controller")
    assert "--gate failures" in campaign
    assert test == "python -m pytest test_controller.py"


@pytest.mark.long
@pytest.mark.parametrize("kind", ["github", "gitlab"])
def test_the_commands_pass_in_a_fresh_folder(kind, tmp_path, capsys):
    folder = tmp_path / "controller"
    main(kind, folder)
    path = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    for line in capsys.readouterr().out.splitlines()[1:]:  # the package is installed
        done = subprocess.run(
            shlex.split(line), cwd=folder, env={**os.environ, "PATH": path}, check=False
        )
        assert done.returncode == 0, line
    assert (folder / "runs" / "ci" / "report.html").is_file()
