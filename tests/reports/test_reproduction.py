"""The paper's results in one command: what it writes, and that it is the same every time."""

from __future__ import annotations

import json

import pytest

from merge_sumo.analysis.reproduction import TABLE_II, Reproduction, Scale, reproduce
from merge_sumo.errors import UserError
from merge_sumo.reports.figures import write_reproduction

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
def tiny(tmp_path_factory) -> Reproduction:
    """Return what is found with very little."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MERGE_SUMO_CACHE", str(tmp_path_factory.mktemp("cache")))
        return reproduce(TINY)


class TestATinyReproduction:
    def test_writes_the_table_every_figure_and_a_page_that_shows_them(self, tiny, tmp_path):
        index = write_reproduction(tiny, tmp_path)
        names = {path.name for path in tmp_path.iterdir()}
        assert names == FIGURES | {"table2.md", "table2.json", "index.html"}
        page = index.read_text()
        assert all(f'src="{name}"' in page for name in FIGURES)
        assert "http" not in page
        assert "<script" not in page
        assert "it is too small for shares and regions" in page
        record = json.loads((tmp_path / "table2.json").read_text())
        assert record == json.loads(json.dumps(tiny.to_record()))
        with pytest.raises(UserError, match="exists"):
            write_reproduction(tiny, tmp_path)

    def test_puts_our_numbers_next_to_those_of_the_paper(self, tiny):
        table = "\n".join(tiny.lines())
        for column in tiny.to_record()["columns"]:
            ours = column["samplers"]["gpr"]["fmc"]["median"]
            assert f"{ours:.4f} ({column['paper']['gpr']:.4f})" in table
            assert f"{column['truth_fmc']:.4f} ({column['paper']['truth']:.4f})" in table
            assert f"{column['limit_fmc']:.4f}" in table
            for sampler in column["samplers"].values():
                assert sampler["fmc"]["median"] <= column["limit_fmc"]
        assert "| gpr / truth | - (0.78) | - (0.69) | - (0.44) |" in table
        assert "| coverage / limit |" in table
        assert "The truth of level-0 POV, design1 is too small for shares and regions" in table


def test_the_papers_table_is_the_papers():
    truths = [column.paper["truth"] for column in TABLE_II]
    assert truths == [0.1296, 0.0849, 0.0073]
    # Table II: GPR / truth .78, .69, .44.
    shares = [round(column.paper["gpr"] / column.paper["truth"], 2) for column in TABLE_II]
    assert shares == [0.78, 0.69, 0.44]
