"""The commands benchmark and reproduce, and a campaign that stops early."""

from __future__ import annotations

import json

import pytest
from calling import assert_refused

from merge_sumo.reports.reproduction_page import TABLE_JSON
from merge_sumo.studies.reproduction import TABLE_II, Scale


@pytest.fixture(autouse=True)
def cache(monkeypatch, tmp_path) -> None:
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "cache"))


BENCHMARK = ("benchmark", "--vut", "design1", "--level", "0", "--truth-cases", 300, "--workers", 1)
SMALL = ("--samplers", "uniform,gpr", "--seeds", 2, "--cases", 30, "--batch", 15)


class TestBenchmark:
    def test_prints_one_json_object_with_the_keys_that_are_promised(self, call):
        code, out, err = call(*BENCHMARK, *SMALL, "--json")
        assert code == 0, err
        assert out.count("\n") == 1
        found = json.loads(out)
        assert found["truth_fmc"] > 0.0
        assert found["limit_fmc"] >= found["truth_fmc"]
        assert found["dense_fmc"] == {}
        assert len(found["oracle_fmc_by_batch"]) == 2
        for name in ("uniform", "gpr"):
            assert set(found["samplers"][name]["fmc"]) == {"median", "low", "high"}

    def test_prints_a_line_per_sampler_and_draws_the_figure(self, call, tmp_path):
        code, out, err = call(*BENCHMARK, *SMALL, "--figure", "curves.svg")
        assert code == 0, err
        assert (tmp_path / "curves.svg").read_text().count("<svg") == 1
        assert "figure: curves.svg" in out
        assert {"truth:", "limit:", "oracle:", "uniform", "gpr"} <= {
            line.split()[0] for line in out.splitlines() if line.strip()
        }

    @pytest.mark.parametrize("figure", ["f.pdf", "gone/f.png", "mine.png"])
    def test_refuses_a_figure_that_cannot_be_before_it_runs_anything(self, call, tmp_path, figure):
        (tmp_path / "mine.png").write_text("mine")
        assert_refused(call(*BENCHMARK, *SMALL, "--figure", figure), "--figure")
        assert not (tmp_path / "cache").exists()
        assert (tmp_path / "mine.png").read_text() == "mine"


class TestReproduce:
    @pytest.fixture
    def tiny(self, monkeypatch):
        scale = Scale(seeds=1, truth_cases=(100, 100, 100), batches=1, batch=6)
        monkeypatch.setattr("merge_sumo.studies.reproduction.quick", lambda seeds: scale)
        monkeypatch.setattr("merge_sumo.studies.reproduction.TABLE_II", TABLE_II[:1])

    def test_prints_the_table_and_where_the_rest_is(self, call, tiny, tmp_path):
        code, out, err = call("reproduce", "--quick", "--workers", 1, "--out", "here")
        assert code == 0, err
        assert out.startswith("| FMC: ours (the paper's) |")
        assert "here/index.html" in out.splitlines()[-1]
        assert json.loads((tmp_path / "here" / TABLE_JSON).read_text())["scale"]["seeds"] == 1
        assert_refused(call("reproduce", "--quick", "--out", "here"), "here exists")

    def test_refuses_no_seeds_and_no_workers(self, call, tmp_path):
        assert_refused(call("reproduce", "--seeds", 0, "--out", "here"), "--seeds is 0")
        assert_refused(call("reproduce", "--workers", 0, "--out", "here"), "--workers is 0")
        assert not (tmp_path / "here").exists()
