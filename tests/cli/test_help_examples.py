"""Every example in --help runs as it stands, with a small budget in the place of its own."""

from __future__ import annotations

import re
import shlex
import shutil
from pathlib import Path

import pytest
from support.calling import commands, invoke
from support.campaigning import campaign_settings, run_campaign

import merge_sumo as ms

ROOT = Path(__file__).resolve().parents[2]
SMALL = {"--cases": "20", "--seeds": "1", "--radius": "0.3"}
MORE = {
    "benchmark": ["--cases", "20", "--truth-cases", "100"],
    "probability": ["--cases", "40"],
}
ELSEWHERE = {"train", "reproduce"}
"""These take minutes: tests/training/test_training.py and the README's commands run them small."""


def examples() -> list[str]:
    found = []
    for command in commands().values():
        found += re.findall(r"^Example: +(.*)$", command.help, re.MULTILINE)
    return sorted(found)


@pytest.fixture(scope="module")
def place(tmp_path_factory) -> Path:
    """Return a folder with what the examples name: two campaigns, and the shipped scenarios."""
    folder = tmp_path_factory.mktemp("examples")
    for vut in ("design1", "design2"):
        settings = campaign_settings(vut=vut, cases=60, batch=20, seed=1)
        run_campaign(settings, folder / "runs" / vut)
    shutil.copytree(ROOT / "scenarios" / "stalemate", folder / "scenarios" / "stalemate")
    ms.export(folder / "runs" / "design2", 3, file_format="cases", out=folder / "cases.toml")
    net = (ROOT / "sumo_net" / "us23.net.xml").read_text()
    for ours, theirs in (("main_in", "a"), ("main_out", "b"), ("ramp", "r")):
        net = re.sub(rf"\b{ours}(?=[_\"])", theirs, net)
    (folder / "my.net.xml").write_text(net)
    return folder


@pytest.mark.parametrize("example", [e for e in examples() if e.split()[1] not in ELSEWHERE])
def test_runs(example, place, monkeypatch, tmp_path):
    monkeypatch.chdir(place)
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path))
    words = [word for word in shlex.split(example) if word != "--gui"]
    assert words.pop(0) == "merge-sumo"
    for place_of, word in enumerate(words[:-1]):
        if word in SMALL:
            words[place_of + 1] = SMALL[word]
    words += MORE.get(words[0], [])
    for page in ("changes.html", "changes.xml"):  # of other examples
        Path(page).unlink(missing_ok=True)
    done = invoke(*words)
    # Their ways to say "worse" and "not certain".
    failed = words[0] in ("compare", "rerun") and done.exit_code == 1
    assert done.exit_code == 0 or failed, done.output
