"""What benchmarks append to a file, to follow their figures from version to version."""

from __future__ import annotations

import argparse
import json
import os
import platform
from importlib.metadata import version

import pytest
from bench_record import add_record_option, append_record
from docs_pages import ROOT


def test_a_line_has_the_versions_the_machine_and_the_figures(tmp_path):
    file = tmp_path / "bench.jsonl"
    append_record(file, "host", {"ratio_to_bare": 1.44, "cases_per_s": {32: 3517.0}})
    append_record(file, "vuts", {})
    first, second = map(json.loads, file.read_text(encoding="utf-8").splitlines())
    assert first["figures"] == {"ratio_to_bare": 1.44, "cases_per_s": {"32": 3517.0}}
    assert (first["benchmark"], second["benchmark"]) == ("host", "vuts")
    assert first["python"] == platform.python_version()
    assert first["merge-sumo"] == version("merge-sumo")
    assert {"libsumo", "numpy", "cpu", "commit"} <= first.keys()
    assert first["cpus"] == os.cpu_count()
    assert first["cpu"]
    assert first["date"].endswith("+00:00")


def test_nothing_is_written_without_the_option(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    parser = argparse.ArgumentParser()
    add_record_option(parser)
    append_record(parser.parse_args([]).record, "host", {})
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("path", sorted(ROOT.glob("tools/bench_[!r]*.py")), ids=lambda p: p.stem)
def test_every_benchmark_has_the_option(path):
    text = path.read_text(encoding="utf-8")
    assert "add_record_option(parser)" in text
    assert "append_record(" in text
