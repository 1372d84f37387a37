"""The benchmark of samplers: its number by hand, its truths, and what samplers do wrong."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from math import pi
from pathlib import Path

import numpy as np
import pytest

from merge_sumo import api
from merge_sumo.errors import UserError
from merge_sumo.studies import benchmark_problems, sampler_benchmark
from merge_sumo.studies.benchmark_problems import (
    MANIFEST,
    PROBLEMS,
    TRUTHS,
    ProblemTruth,
    changed_verdicts,
    check_truth,
    make_truth,
    manifest,
    named_problems,
    shipped_truth,
)
from merge_sumo.studies.entrants import Entrant
from merge_sumo.studies.sampler_benchmark import (
    BenchmarkSettings,
    Found,
    SamplerBenchmark,
    Task,
    cases_to,
    fmc_of,
    read_found,
    write_found,
)
from merge_sumo.values.fmc import RADIUS, fmc

DISC = pi * RADIUS**2
FOUR = np.array([[0.2, 0.2], [0.2, 0.8], [0.8, 0.2], [0.8, 0.8]])
"""Failures whose discs do not overlap."""
SETTINGS = BenchmarkSettings(
    seeds=1, cases=400, problems=named_problems(("stateful", "planner")), limit_s=1.0
)


def truth_of(points: np.ndarray) -> ProblemTruth:
    """Return a truth of disjoint failures, of which the oracle takes one after the other."""
    found = np.minimum(np.arange(401), len(points)) * DISC
    return ProblemTruth({0: points}, len(points) * DISC, found, {}, "")


def found_at(rows: list[tuple[int, tuple[float, float]]], problem: str, seed: int = 100) -> Found:
    """Return a search that found failures, (index, point)."""
    task = Task(
        problem=problem,
        sampler="mine",
        seed=seed,
        cases=400,
        sampler_sha256=None,
        truth_sha256="",
        merge_sumo="",
        limit_s=1.0,
    )
    failures = [[float(index), 0.0, *point] for index, point in rows]
    return Found(
        task=task,
        ran=400,
        failures=failures,
        fmc=[(n, fmc_of(failures, n)) for n in SETTINGS.curve],
        cases_to_most=cases_to(0.9 * 4 * DISC, failures),
        sampler_s=0.0,
    )


def scored(*searches: list[Found]) -> SamplerBenchmark:
    """Return the benchmark of the searches of one sampler on the problems of SETTINGS."""
    names = [problem.name for problem in SETTINGS.problems]
    by_problem = dict(zip(names, searches, strict=True))
    truths = dict.fromkeys(names, truth_of(FOUR))
    return SamplerBenchmark.of(SETTINGS, truths, [Entrant("mine")], {"mine": by_problem})


class TestTheNumber:
    def test_is_the_mean_of_medians_by_hand(self):
        one, two, three, four = (tuple(point) for point in FOUR.tolist())
        stateful = [
            found_at([(0, one), (60, two), (399, three)], "stateful"),  # .25 .5 .75
            found_at([(49, one)], "stateful", 101),  # .25 .25 .25
            found_at([(50, one), (99, two), (100, four)], "stateful", 102),  # 0 .5 .75
        ]
        planner = [found_at([(k, p) for k, p in enumerate((one, two, three, four))], "planner")] * 3
        result = scored(stateful, planner)
        score = result.samplers["mine"]
        assert score.problems["stateful"].median(50) == pytest.approx(0.25)
        assert score.by_cases == pytest.approx({50: 0.625, 100: 0.75, 400: 0.875})
        assert score.number == pytest.approx(0.75)
        # Of single seeds: (1 + mean of their three shares) / 2.
        assert score.by_seed == pytest.approx([0.75, 0.625, (1 + 1.25 / 3) / 2])

    def test_of_failures_beyond_the_truth_is_not_more_than_one(self):
        beyond = [(k, (0.05 + 0.1 * (k % 10), 0.05 + 0.1 * (k // 10))) for k in range(100)]
        result = scored([found_at(beyond, "stateful")], [found_at(beyond, "planner")])
        assert fmc_of([[0.0, 0.0, *p] for _, p in beyond], 1) == pytest.approx(100 * DISC)
        assert result.samplers["mine"].by_cases[400] == 1.0

    def test_of_a_perfect_sampler_is_that_of_the_oracle(self):
        perfect = [(k, (p[0], p[1])) for k, p in enumerate(FOUR.tolist())]
        result = scored([found_at(perfect, "stateful")], [found_at(perfect, "planner")])
        score = result.samplers["mine"]
        assert score.number == pytest.approx(result.oracle_number) == pytest.approx(1.0)
        assert score.problems["planner"].cases_to_most == 4
        assert score.over_oracle == pytest.approx(1.0)
        assert score.reached == [1.0, 1.0]

    def test_of_one_that_finds_nothing_is_zero_and_reaches_nothing(self):
        score = scored([found_at([], "stateful")], [found_at([], "planner")]).samplers["mine"]
        assert (score.number, score.over_oracle, score.reached) == (0.0, None, [])

    def test_counts_what_there_is_of_fewer_cases(self):
        assert replace(SETTINGS, cases=120).counted == (50, 100)
        assert replace(SETTINGS, cases=30).counted == (30,)
        assert replace(SETTINGS, cases=30).curve == (5, 10, 20, 30)

    def test_cases_to_a_target_are_the_first_with_it(self):
        rows = [[4.0, 0.0, 0.2, 0.2], [9.0, 0.0, 0.2, 0.2], [30.0, 1.0, 0.2, 0.2]]
        assert cases_to(DISC * 0.99, rows) == 5
        assert cases_to(DISC * 1.01, rows) == 31, "each level has its balls"
        assert cases_to(DISC * 2.01, rows) is None


class TestTheTruths:
    def test_are_small_and_those_of_the_manifest(self):
        files = {path.stem: path for path in TRUTHS.glob("*.npz")}
        assert set(files) == {problem.name for problem in PROBLEMS} == set(manifest().truths)
        assert len(PROBLEMS) == 12
        assert sum(path.stat().st_size for path in TRUTHS.iterdir()) < 2_000_000
        for problem in PROBLEMS:
            truth, known = shipped_truth(problem), manifest().truths[problem.name]
            assert known.failures == {str(k): len(points) for k, points in truth.failures.items()}
            assert (np.diff(truth.oracle) >= -1e-3 * truth.fmc).all(), "to the error of fmc"
            assert truth.share(truth.oracle[400]) > 0.3
            assert all(growth < 0.45 for growth in known.growth.values())

    def test_have_the_fmc_of_their_failures(self):
        for name in ("stateful", "islands"):
            truth = shipped_truth(named_problems((name,))[0])
            assert truth.fmc == pytest.approx(sum(map(fmc, truth.failures.values())), rel=1e-9)

    def test_have_the_verdicts_that_cases_have_today(self):
        for problem in named_problems(("stateful", "ring")):
            assert check_truth(problem, problem.plan(), shipped_truth(problem)) is None

    @pytest.mark.long
    def test_have_the_verdicts_of_every_problem(self):
        for problem in PROBLEMS:
            assert changed_verdicts(problem, problem.plan(), shipped_truth(problem)) == 0

    def test_are_made_again_alike(self, tmp_path, monkeypatch):
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "cache"))
        (problem,) = named_problems(("stateful",))
        made = make_truth(problem, tmp_path, cases=2000)
        again = np.load(tmp_path / "stateful.npz", allow_pickle=False)["failures_0"]
        dense = np.load(TRUTHS / "stateful.npz", allow_pickle=False)["failures_0"]
        assert made.failures == {"0": len(again)}
        assert len(again) > 30
        assert np.array_equal(again, dense[: len(again)]), "they are the first cases of the dense"

    def test_that_were_changed_are_refused(self, tmp_path):
        shutil.copytree(TRUTHS, tmp_path / "truths")
        (problem,) = named_problems(("stateful",))
        path = tmp_path / "truths" / "stateful.npz"
        assert shipped_truth(problem, tmp_path / "truths").fmc > 0.0
        content = bytearray(path.read_bytes())
        content[len(content) // 2] ^= 1
        path.write_bytes(content)
        with pytest.raises(UserError, match=f"is not the truth that {MANIFEST} names"):
            shipped_truth(problem, tmp_path / "truths")

    def test_of_code_with_other_verdicts_are_refused(self):
        (problem,) = named_problems(("stateful",))
        plan, truth = problem.plan(), shipped_truth(problem)
        failed = truth.probes[0].failed.copy()
        failed[3] ^= True
        other = replace(truth, probes={0: replace(truth.probes[0], failed=failed)})
        with pytest.raises(UserError, match="1 of 96 probe cases have another verdict"):
            check_truth(problem, plan, other)
        remark = check_truth(problem, plan, replace(truth, inputs_sha256="0"))
        assert remark is not None
        assert "all 96 probe cases have the same verdicts" in remark


SAMPLERS = '''
"""Samplers that keep the contract, and go wrong where a pool has one level."""

import os
import time

from merge_sumo.samplers.base import Sampler
from merge_sumo.samplers.uniform import UniformSampler


class Fair(UniformSampler):
    def ask(self, n):
        if self.proposed() and len(self.pool.levels) == 1:
            self.goes_wrong()
            return self.answer(super().ask(n))
        return super().ask(n)

    def goes_wrong(self):
        pass

    def answer(self, cases):
        return cases


class Raises(Fair):
    def goes_wrong(self):
        raise ValueError("no idea")


class Hangs(Fair):
    def goes_wrong(self):
        time.sleep(60.0)


class Dies(Fair):
    def goes_wrong(self):
        os._exit(3)


class Short(Fair):
    def answer(self, cases):
        return cases[1:]


class Strange(Fair):
    def answer(self, cases):
        return ["a case" for _ in cases]


class Seedless(UniformSampler):
    def __init__(self, pool, seed, predictor=None):
        super().__init__(pool, 0, predictor)
'''


@pytest.fixture
def mine(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "mine.py"
    path.write_text(SAMPLERS)
    return path


class TestSamplersOfOthers:
    def test_keep_what_they_found_before_a_fault(self, mine):
        names = ("Fair", "Raises", "Hangs", "Dies", "Short", "Strange")
        result = api.benchmark(
            [f"mine.py:{name}" for name in names],
            problems=["stateful"],
            seeds=1,
            cases=40,
            limit_s=3.0,
            out="out",
            workers=1,
        )
        faults = {
            score.entrant.label: score.problems["stateful"].faults.get(100, "")
            for score in result.samplers.values()
        }
        assert faults["Fair"] == ""
        assert faults["Raises"] == "ValueError: no idea (mine.py, line 27)"
        assert faults["Hangs"] == "it took longer than 3 s"
        assert faults["Dies"].startswith("it ended its process each time")
        assert faults["Short"] == "asked for 20 cases, it gives 19"
        assert faults["Strange"] == "it gives 'a case', which is no case of the pool"
        ran = {
            path.name.split("-")[1]: json.loads(path.read_text())["ran"]
            for path in Path("out/searches").iterdir()
        }
        assert ran == {"Fair": 40, "Raises": 20, "Hangs": 20, "Dies": 0, "Short": 20, "Strange": 20}
        said = "\n".join(result.lines())
        assert "Raises: faults ended 1 of its searches, the first: ValueError: no idea" in said
        page = Path("out/benchmark.html").read_text()
        assert "ValueError: no idea" in page
        assert "<script" not in page
        record = json.loads(Path("out/benchmark.json").read_text())
        assert record == json.loads(json.dumps(result.to_record()))
        assert record["samplers"]["mine.py:Raises"]["faults"] == 1

    def test_that_break_the_contract_do_not_enter(self, mine):
        with pytest.raises(UserError, match="breaks the contract of samplers: not so: proposes"):
            api.benchmark(["mine.py:Seedless"], problems=["stateful"], out="out", cases=10)
        assert not Path("out").exists()

    @pytest.mark.parametrize(
        ("spec", "sentence"),
        [
            ("unifrom", "there is no sampler 'unifrom': did you mean uniform"),
            ("mine.py", "mine.py is a file: name a class of it"),
            ("other.py:Fair", "there is no sampler 'other.py:Fair'"),
            ("mine.py:Sampler2", "has no sampler 'Sampler2'"),
        ],
    )
    def test_that_are_none_are_a_sentence(self, mine, spec, sentence):
        with pytest.raises(UserError, match=sentence):
            api.benchmark([spec], problems=["stateful"], out="out", cases=10)


def test_goes_on_where_it_was_stopped(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def run(seeds: int, **given) -> SamplerBenchmark:
        return api.benchmark(
            ["uniform"], problems=["stateful"], cases=10, seeds=seeds, out="out", **given
        )

    class StoppedError(Exception):
        pass

    def stop() -> None:
        raise StoppedError

    with pytest.raises(StoppedError):
        run(3, check=stop)
    (first,) = Path("out/searches").iterdir()
    before = first.stat().st_mtime_ns
    result = run(3, resume=True)
    assert first.stat().st_mtime_ns == before
    assert len(list(Path("out/searches").iterdir())) == 3
    first.write_text(first.read_text().replace('"ran": 10', '"ran": 11'))
    assert run(3, resume=True).to_record()["samplers"] == result.to_record()["samplers"]
    assert '"ran": 10' in first.read_text(), "a damaged search runs again"
    with pytest.raises(UserError, match="exists"):
        run(3)


def test_a_search_is_read_back_whatever_it_found(tmp_path):
    nothing = found_at([], "stateful")
    for found in (nothing, replace(nothing, failures=[[3, 0, 0.5, 1]], fmc=[(400, 0)])):
        write_found(tmp_path, found)
        assert read_found(tmp_path, found.task) == found
        assert read_found(tmp_path, replace(found.task, sampler_sha256="other")) is None


def test_refuses_numbers_and_names_that_are_none():
    for given, sentence in (
        ({"seeds": 0}, "--seeds is 0"),
        ({"cases": 500}, "--cases is 500"),
        ({"limit_s": 0.0}, "--limit is 0.0"),
        ({"problems": ["tabel"]}, "there is no problem 'tabel': did you mean table"),
        ({"problems": []}, "--problems is empty"),
    ):
        with pytest.raises(UserError, match=sentence):
            api.benchmark(["uniform"], out="nowhere", **given)
    with pytest.raises(UserError, match="name at least one sampler"):
        api.benchmark([])


def test_a_problem_needs_a_truth_in_the_manifest(tmp_path):
    (tmp_path / MANIFEST).write_text('{"truths": {}}')
    with pytest.raises(UserError, match="is not the truth"):
        shipped_truth(PROBLEMS[0], tmp_path)
    assert max(sampler_benchmark.COUNTED) == benchmark_problems.ORACLE_CASES
