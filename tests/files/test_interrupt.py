"""A campaign that is stopped ends soon, whatever runs, and leaves nothing behind."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

SLEEPY = "import time\ndef sleepy(seen):\n    time.sleep({})\n    return 0.0\n"


def begun(folder: Path, step_s: float, *more: str) -> subprocess.Popen[str]:
    """Start a campaign of a slow controller; return it when its folder is there."""
    (folder / "slow.py").write_text(SLEEPY.format(step_s))
    (folder / "tmp").mkdir()
    words = ["campaign", "--vut", "slow.py:sleepy", "--level", "0", "--out", "run", *more]
    process = subprocess.Popen(
        [sys.executable, "-m", "merge_sumo.cli", *words],
        cwd=folder,
        env={**os.environ, "TMPDIR": str(folder / "tmp")},
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    for _ in range(600):
        if (folder / "run").exists():
            break
        time.sleep(0.1)
    time.sleep(4.0)
    return process


@pytest.mark.slow
def test_sigterm_ends_a_controller_that_takes_seconds_a_step(tmp_path):
    process = begun(tmp_path, 3.0, "--deadline", "10")
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=20)[1]
    assert process.returncode == 128 + signal.SIGTERM
    assert "continue with: merge-sumo campaign --resume run" in said
