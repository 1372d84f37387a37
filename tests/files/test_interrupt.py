"""A campaign that is stopped ends soon, whatever runs, and leaves nothing behind."""

from __future__ import annotations

import signal
import time

import pytest
from support.attacks import Workspace
from support.processes import wait_for

SLEEPY = "import time\ndef sleepy(seen):\n    time.sleep(3.0)\n    return 0.0\n"


@pytest.mark.slow
def test_sigterm_ends_a_controller_that_takes_seconds_a_step(tmp_path):
    (tmp_path / "slow.py").write_text(SLEEPY)
    words = "campaign --vut slow.py:sleepy --level 0 --out run --deadline 10"
    process = Workspace(tmp_path).start(*words.split())
    assert wait_for((tmp_path / "run").exists)
    time.sleep(4.0)
    process.send_signal(signal.SIGTERM)
    said = process.communicate(timeout=20)[1]
    assert process.returncode == 128 + signal.SIGTERM
    assert "continue with: merge-sumo campaign --resume run" in said
