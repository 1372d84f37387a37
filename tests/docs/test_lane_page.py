"""The page about where to merge says what its controllers do."""

from __future__ import annotations

import json
import re
import shlex
import shutil
from pathlib import Path
from statistics import median

import pytest

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "tutorials" / "acceleration-lane.md").read_text(encoding="utf-8")
SOURCE = re.findall(r"^```python.*?\n(.*?)^```$", PAGE, flags=re.DOTALL | re.MULTILINE)[0]
STEPS = [
    shlex.split(line)[1:]
    for block in re.findall(r"^```bash\n(.*?)^```$", PAGE, flags=re.DOTALL | re.MULTILINE)
    for line in block.splitlines()
]


def places(run: Path) -> list[float]:
    lines = (run / "outcomes.jsonl").read_text().splitlines()
    return [json.loads(line)["lane_share"] for line in lines]


@pytest.mark.slow
def test_a_controller_that_merges_earlier_fails_less(tmp_path, monkeypatch, command_line):
    (tmp_path / "my_merge.py").write_text(SOURCE, encoding="utf-8")
    (tmp_path / "runs").mkdir()
    shutil.copytree(ROOT / "sumo_net", tmp_path / "sumo_net")
    monkeypatch.chdir(tmp_path)
    made = re.search(r"^merge-sumo (scenario new .*)$", PAGE, flags=re.MULTILINE)
    assert made is not None
    assert command_line(*shlex.split(made[1]))[0] == 0
    said = []
    for step in STEPS:
        code, out, err = command_line(*step)
        assert code in (0, 1), err
        said.append(out)
    late, first_gap, compared = said
    assert "47 failures" in late
    assert "`Late` fails in 47 of these 100 cases" in PAGE
    assert "2 failures" in first_gap
    assert "fails in 2 of 100 cases" in PAGE
    assert "47 failures" in compared
    assert "2 failures" in compared
    assert median(places(tmp_path / "runs" / "late")) == pytest.approx(0.83, abs=0.005)
    assert median(places(tmp_path / "runs" / "first-gap")) < 0.05
