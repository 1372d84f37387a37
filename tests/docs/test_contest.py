"""tools/contest.py: its number by hand, its truths, samplers that go wrong, guests."""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
from dataclasses import replace
from importlib.util import find_spec
from math import pi
from pathlib import Path

import numpy as np
import pytest
from ci_snippets import files
from contest import Found, Search, problem_score, sampler_score
from entrants import Entrant, sampler_class
from oracle import oracle
from problems import (
    MANIFEST,
    PROBLEMS,
    TRUTHS,
    ProblemTruth,
    check_truth,
    manifest,
    named_problems,
    shipped_truth,
)

from merge_sumo.errors import UserError
from merge_sumo.metrics.fmc import RADIUS, fmc
from merge_sumo.testing import SamplerContract

ROOT = Path(__file__).resolve().parents[2]
PAGE = (ROOT / "docs" / "explanation" / "benchmark.md").read_text(encoding="utf-8")
DISC = pi * RADIUS**2
FOUR = [(0.2, 0.2), (0.2, 0.8), (0.8, 0.2), (0.8, 0.8)]
"""Failures whose discs do not overlap."""
TRUTH = ProblemTruth({0: np.array(FOUR)}, 4 * DISC, np.minimum(np.arange(401), 4) * DISC, {})
(STATEFUL,) = named_problems(("stateful",))


def found_at(*rows):
    """Return a search that found failures, (index, point)."""
    words = dict.fromkeys(("problem", "sampler", "truth_sha256", "merge_sumo"), "")
    search = Search(**words, seed=100, cases=400, sampler_sha256=None)
    failures = [[float(index), 0.0, *point] for index, point in rows]
    return Found(search=search, ran=400, failures=failures, sampler_s=0.0)


def test_the_number_is_the_mean_of_medians_by_hand():
    one, two, three, four = FOUR
    searches = [
        found_at((0, one), (60, two), (399, three)),  # .25 .5 .75
        found_at((49, one)),  # .25 .25 .25
        found_at((50, one), (99, two), (100, four)),  # 0 .5 .75
    ]
    first = problem_score(searches, TRUTH)
    second = problem_score([found_at(*enumerate(FOUR))] * 3, TRUTH)
    score = sampler_score(Entrant("mine"), {"first": first, "second": second})
    assert score.by_cases == pytest.approx({50: 0.625, 100: 0.75, 400: 0.875})
    assert score.number == pytest.approx(0.75)
    assert second.number == pytest.approx(1.0)
    assert second.cases_to_90 == 4
    nothing = sampler_score(Entrant("mine"), {"first": problem_score([found_at()], TRUTH)})
    assert (nothing.number, nothing.cases_to_90_over_oracle) == (0.0, None)


def test_the_truths_are_those_of_the_manifest():
    assert {path.stem for path in TRUTHS.glob("*.npz")} == {problem.name for problem in PROBLEMS}
    for problem in PROBLEMS:
        truth, known = shipped_truth(problem), manifest().truths[problem.name]
        assert known.failures == {str(k): len(points) for k, points in truth.failures.items()}
        assert (np.diff(truth.oracle) >= -1e-3 * truth.fmc).all(), "to the error of fmc"
    (islands,) = named_problems(("islands",))
    truth = shipped_truth(islands)
    assert truth.fmc == pytest.approx(sum(map(fmc, truth.failures.values())), rel=1e-9)


def test_a_truth_that_was_changed_is_refused(tmp_path):
    shutil.copytree(TRUTHS, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "stateful.npz"
    path.write_bytes(path.read_bytes() + b"\0")
    with pytest.raises(UserError, match=f"is not the truth that {MANIFEST} names"):
        shipped_truth(STATEFUL, tmp_path)


def test_a_truth_of_code_with_other_verdicts_is_refused():
    plan, truth = STATEFUL.plan(), shipped_truth(STATEFUL)
    check_truth(STATEFUL, plan, truth)
    failed = truth.probes[0].failed.copy()
    failed[3] ^= True
    truth = replace(truth, probes={0: replace(truth.probes[0], failed=failed)})
    with pytest.raises(UserError, match="1 of 96 probe cases have another verdict"):
        check_truth(STATEFUL, plan, truth)


MINE = """
import os
import time

from merge_sumo.samplers.uniform import UniformSampler


class Raises(UniformSampler):
    def ask(self, n):
        # The contract of samplers, too, asks; its pools have more levels.
        if self.proposed() and len(self.pool.levels) == 1:
            self.goes_wrong()
        return super().ask(n)

    def goes_wrong(self):
        raise ValueError("no idea")


class Hangs(Raises):
    def goes_wrong(self):
        time.sleep(60.0)


class Dies(Raises):
    def goes_wrong(self):
        os._exit(3)


class Seedless(UniformSampler):
    def __init__(self, pool, seed, predictor=None):
        super().__init__(pool, 0, predictor)
"""


def contest(folder, *arguments):
    command = [sys.executable, str(ROOT / "tools" / "contest.py"), *arguments, "--workers", "1"]
    return subprocess.run(
        command, cwd=folder, capture_output=True, text=True, timeout=300, check=False
    )


@pytest.mark.slow
def test_a_contest_keeps_what_was_found_before_a_fault_and_continues(tmp_path):
    (tmp_path / "mine.py").write_text(MINE)
    (tmp_path / "near_failures.py").write_text(files(PAGE)["near_failures.py"])
    near = "near_failures.py:NearFailures"
    specs = (near, "mine.py:Raises", "mine.py:Hangs", "mine.py:Dies")
    sizes = ("--problems", "stateful", "--seeds", "1", "--cases", "60", "--limit", "3")
    done = contest(tmp_path, *specs, *sizes)
    assert done.returncode == 0, done.stderr
    record = (tmp_path / "benchmark" / "benchmark.json").read_bytes()
    samplers = json.loads(record)["samplers"]
    assert samplers[near]["number"] > 0.0
    faults = [samplers[name]["problems"]["stateful"]["faults"] for name in specs]
    assert faults[0] == {}
    assert faults[1]["100"].startswith("ValueError: no idea (mine.py")
    assert faults[2]["100"].startswith("it took longer than 3 s")
    assert faults[3]["100"].startswith("it ended its process")
    ran = [json.loads(path.read_text())["ran"] for path in tmp_path.glob("*/searches/*")]
    assert sorted(ran) == [0, 20, 20, 60]
    assert contest(tmp_path, *specs, *sizes).returncode == 0
    assert (tmp_path / "benchmark" / "benchmark.json").read_bytes() == record
    refused = contest(tmp_path, "mine.py:Seedless", *sizes)
    assert refused.returncode == 1
    assert "breaks the contract of samplers" in refused.stderr


GUESTS = {
    "sobol.py:SobolSampler": "scipy",
    "ak_mcs.py:AkMcsSampler": "openturns",
    "cma_me.py:CmaMeSampler": "ribs",
    "straddle.py:StraddleSampler": "botorch",
}


@pytest.mark.parametrize("guest", GUESTS)
class TestGuests(SamplerContract):
    @pytest.fixture(autouse=True)
    def load(self, guest):
        if find_spec(GUESTS[guest]) is None:
            pytest.skip(f"{GUESTS[guest]} is not installed")
        self.sampler = sampler_class(str(ROOT / "tools" / "guests" / guest))


def test_the_oracle_takes_the_most_useful_failure_first():
    # Two that overlap and one apart: one of the two, the one apart, then the rest.
    points = np.array([[0.2, 0.2], [0.22, 0.2], [0.8, 0.8]])
    curve = oracle({0: points}, 10)
    assert curve[:3] == pytest.approx([0.0, DISC, 2.0 * DISC])
    assert curve[3] == curve[10] == pytest.approx(fmc(points))
