"""The sampler that docs/explanations/benchmark.md shows enters the benchmark as the page says."""

from __future__ import annotations

from pathlib import Path

from ci_snippets import files

from merge_sumo import api
from merge_sumo.studies.benchmark_problems import PROBLEMS

PAGE = Path(__file__).resolve().parents[2] / "docs" / "explanations" / "benchmark.md"
TEXT = PAGE.read_text(encoding="utf-8")


def test_the_sampler_of_the_page_enters(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shown = files(TEXT)
    assert list(shown) == ["near_failures.py"]
    assert "merge-sumo benchmark near_failures.py:NearFailures uniform" in TEXT
    Path("near_failures.py").write_text(shown["near_failures.py"], encoding="utf-8")
    result = api.benchmark(
        ["near_failures.py:NearFailures"], problems=["stateful"], seeds=1, cases=60, out="out"
    )
    (score,) = result.samplers.values()
    assert score.faults == 0
    assert score.number > 0.0


def test_the_table_of_the_page_has_a_row_for_each_problem():
    rows = [line for line in TEXT.splitlines() if line.startswith("| `")]
    named = {row.split("`")[1]: row for row in rows}
    assert [problem.name for problem in PROBLEMS] == list(named)[: len(PROBLEMS)]
    for problem in PROBLEMS:
        row = named[problem.name]
        assert f"`{problem.vut}`" in row
        assert f"| {problem.scenario} |" in row
        assert not problem.sense or f"--sense {problem.sense}" in row
        assert not problem.act or f"--act {problem.act}" in row
