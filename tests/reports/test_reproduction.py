"""The paper's results in one command: what it writes, and that it is the same every time."""

from __future__ import annotations

import json
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import pytest

from merge_sumo.errors import UserError
from merge_sumo.reports.reproduction_page import write_reproduction_page
from merge_sumo.studies.reproduction import (
    SAMPLERS,
    TABLE_II,
    ColumnResult,
    Scale,
    quick,
    read_reproduction,
    reproduce,
    table_markdown,
)
from merge_sumo.system.workers import open_workers

FIGURES = {
    "cases-level0.png",
    "cases-level1.png",
    "cases-level2.png",
    "curves-level0.png",
    "curves-level1.png",
    "curves-level2.png",
    "gpr-surface-level1.png",
    "allocation.png",
}
TINY = Scale(seeds=1, truth_cases=(100, 100, 100), batches=2, batch=6)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    """Return a folder with everything, of very little, and what was said meanwhile."""
    folder = tmp_path_factory.mktemp("reproduce") / "out"
    said = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MERGE_SUMO_CACHE", str(folder.parent / "cache"))
        reproduce(folder, TINY, on_part=lambda *what: said.append(what))
    return write_reproduction_page(folder), said


class TestATinyReproduction:
    def test_writes_the_table_every_figure_and_a_page_that_shows_them(self, tiny):
        index, _ = tiny
        names = {path.name for path in index.parent.iterdir()}
        assert names == FIGURES | {"reproduction.json", "table2.md", "table2.json", "index.html"}
        page = index.read_text()
        assert all(f'src="{name}"' in page for name in FIGURES)
        assert "http" not in page
        assert "<script" not in page

    def test_puts_our_numbers_beside_the_papers(self, tiny):
        index, _ = tiny
        record = json.loads((index.parent / "table2.json").read_text())
        assert [column["paper_fmc"]["gpr"] for column in record["columns"]] == [
            0.1012,
            0.0585,
            0.0032,
        ]
        markdown = (index.parent / "table2.md").read_text()
        for column in record["columns"]:
            ours = column["samplers"]["coverage"]["fmc_median"]
            assert f"{ours:.4f}" in markdown
            assert f"{column['truth_fmc']:.4f} ({column['paper_fmc']['truth']:.4f})" in markdown
            assert f"{column['limit_fmc']:.4f} (-)" in markdown
            assert column["dense_fmc"] is None
            for sampler in column["samplers"].values():
                assert sampler["fmc_median"] <= column["limit_fmc"]
        assert "| gpr / truth |" in markdown
        assert "| coverage / limit |" in markdown
        assert "| coverage / truth after " in markdown

    def test_shows_a_dense_truth_where_there_is_one(self):
        found: Any = SimpleNamespace(
            fmc_median=0.09,
            fmc_over_truth_median=1.0,
            fmc_over_limit_median=0.9,
            cases_by_batch=[20],
            fmc_by_batch_median=[0.09],
        )
        compared = dict.fromkeys(SAMPLERS, found)
        of_one = ColumnResult(TABLE_II[0], 0.08, 7, 1, [], None, 0.1, compared)
        of_two = replace(of_one, dense_fmc=0.095)
        markdown = table_markdown({"one": of_one, "two": of_two})
        assert "| dense truth | - (-) | 0.0950 (-) |" in markdown
        assert "| coverage / dense truth | - | 0.947 |" in markdown
        assert "dense" not in table_markdown({"one": of_one})

    def test_divides_by_no_truth_that_is_too_small(self, tiny):
        index, _ = tiny
        column = json.loads((index.parent / "table2.json").read_text())["columns"][0]
        assert column["truth_failures"] > 0
        assert column["samplers"]["gpr"]["fmc_over_truth_median"] is None
        markdown = (index.parent / "table2.md").read_text()
        assert "The truth of level-0 POV, design1 is too small to be divided by" in markdown
        assert "it is too small to be divided by" in index.read_text()

    def test_says_how_far_it_is(self, tiny):
        _, said = tiny
        last = {title: (done, total) for title, done, total, *_ in said}
        assert last["design1 v level 0"] == (5, 5)
        assert last["design2 v level 0/1/2"] == (2, 2)
        assert last["truth of design2 at level 2"] == (100, 100)

    def test_is_drawn_again_from_its_file_alone(self, tiny, tmp_path):
        index, _ = tiny
        (tmp_path / "reproduction.json").write_bytes(
            (index.parent / "reproduction.json").read_bytes()
        )
        again = write_reproduction_page(tmp_path)
        assert again.read_bytes() == index.read_bytes()
        for name in FIGURES:
            assert (tmp_path / name).read_bytes() == (index.parent / name).read_bytes()

    @pytest.mark.parametrize("content", ["", "[]", '{"scale": {}}', "[" * 100_000])
    def test_of_a_file_that_is_none_is_refused(self, tmp_path, content):
        (tmp_path / "reproduction.json").write_text(content)
        with pytest.raises(UserError, match="is not as it was written"):
            read_reproduction(tmp_path)

    def test_refuses_a_folder_that_exists(self, tiny):
        index, _ = tiny
        with pytest.raises(UserError, match="exists"):
            reproduce(index.parent, TINY)


def test_no_seeds_are_refused():
    with pytest.raises(UserError, match="--seeds is 0"):
        Scale(seeds=0)


def test_the_papers_table_is_the_papers():
    truths = [column.paper["truth"] for column in TABLE_II]
    assert truths == [0.1296, 0.0849, 0.0073]
    # Table II: GPR / truth .78, .69, .44.
    shares = [round(column.paper["gpr"] / column.paper["truth"], 2) for column in TABLE_II]
    assert shares == [0.78, 0.69, 0.44]
    for column in TABLE_II:
        order = [column.paper[name] for name in ("gpr", "subset", "annealing", "uniform")]
        assert order == sorted(order, reverse=True)


@pytest.mark.long
def test_a_quick_reproduction_is_the_same_twice(tmp_path, monkeypatch):
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "cache"))
    for name, count in (("a", 2), ("b", 1)):
        with open_workers(count) as workers:
            reproduce(tmp_path / name, quick(2), workers=workers)
        write_reproduction_page(tmp_path / name)
    for path in (tmp_path / "a").iterdir():
        assert path.read_bytes() == (tmp_path / "b" / path.name).read_bytes(), path.name
