"""A process that is tied to another one ends with it, also where the other is gone already."""

from __future__ import annotations

import os
import signal
import subprocess
import sys

import pytest

TIED = """
import os, sys
from merge_sumo.spawning import end_with

go, lifeline = map(int, sys.argv[1:])
os.read(go, 1)
end_with(lifeline)
print("tied", flush=True)
os.read(os.pipe()[0], 1)
"""


@pytest.mark.skipif(os.name != "posix", reason="pipes are passed on by POSIX alone")
@pytest.mark.parametrize("gone_before", [False, True])
def test_a_process_ends_with_the_other_end_of_its_lifeline(gone_before):
    lifeline, ours = os.pipe()
    go, start = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-c", TIED, str(go), str(lifeline)],
        pass_fds=(go, lifeline),
        stdout=subprocess.PIPE,
    )
    for end in (go, lifeline):
        os.close(end)
    assert process.stdout is not None
    if gone_before:
        os.close(ours)
    os.write(start, b"!")
    if not gone_before:
        assert process.stdout.readline() == b"tied\n"
        os.close(ours)
    assert process.wait(60) == -signal.SIGKILL
    process.stdout.close()
    os.close(start)
