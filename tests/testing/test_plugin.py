"""An installed package with one of each extension: in help, records, report and documentation."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

PLUGIN = Path(__file__).parents[1] / "plugin"
TOOLS = Path(__file__).parents[2] / "tools"


@pytest.fixture(scope="module")
def merge_sumo(tmp_path_factory):
    """Return a function that runs a command where the package is installed, as pip leaves it."""
    site, work = (tmp_path_factory.mktemp(name) for name in ("site", "work"))
    shutil.copy(PLUGIN / "merge_sumo_example.py", site)
    project = tomllib.loads((PLUGIN / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    info = site / "merge_sumo_example-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(
        f"Metadata-Version: 2.1\nName: {project['name']}\nVersion: {project['version']}\n"
    )
    groups = (
        "\n".join([f"[{group}]", *(f"{name} = {at}" for name, at in entries.items())])
        for group, entries in project["entry-points"].items()
    )
    (info / "entry_points.txt").write_text("\n".join(groups))
    path = os.pathsep.join([str(site), str(PLUGIN.parents[1])])
    environment = {**os.environ, "PYTHONPATH": path, "COLUMNS": "200", "TERM": "dumb"}

    def run(*arguments: object, program: tuple[str, ...] = ("-m", "merge_sumo.cli")) -> str:
        command = [sys.executable, *program, *map(str, arguments)]
        done = subprocess.run(
            command, capture_output=True, text=True, cwd=work, env=environment, check=False
        )
        assert done.returncode in (0, 1), done.stderr
        return done.stdout + done.stderr

    run.work = work  # type: ignore[attr-defined]
    return run


@pytest.fixture(scope="module")
def folder(merge_sumo) -> Path:
    """Return a campaign with the sampler, the VUT kind and the criterion of the package."""
    merge_sumo(
        *("campaign", "--vut", "constant:0.5", "--level", "0", "--sampler", "middle", "-q"),
        *("--cases", "40", "--fail-when", "near", "--out", "run"),
    )
    return merge_sumo.work / "run"


def test_help_and_lists_name_what_it_brings(merge_sumo):
    options = merge_sumo("campaign", "--help")
    assert "coverage or middle" in options
    assert "unsafe or near" in options
    assert "csv or endings" in merge_sumo("export", "--help")
    assert "constant:MPS2" in merge_sumo("vuts")


def test_the_page_of_measures_has_its_measure(merge_sumo):
    made = f"import sys; sys.path.append({str(TOOLS)!r}); import docs_pages as d"
    page = merge_sumo(f"{made}; print(d.measures_page())", program=("-c",))
    assert "| `closest_m` | m | least distance of the front bumpers" in page


@pytest.mark.slow
def test_records_have_its_measure_after_those_of_the_package(folder):
    records = [json.loads(line) for line in (folder / "outcomes.jsonl").read_text().splitlines()]
    assert len(records) == 40
    names = list(records[0])
    assert names.index("closest_m") == names.index("margin") - 1
    assert {r["margin"] < 0.0 for r in records} == {True, False}
    assert all((r["margin"] < 0.0) == (r["closest_m"] < 4.0) for r in records)


@pytest.mark.slow
def test_the_record_of_the_campaign_has_the_version_of_the_package(folder):
    record = json.loads((folder / "campaign.json").read_text(encoding="utf-8"))
    assert record["versions"]["merge-sumo-example"] == "1.0"


def test_the_report_has_its_section_and_a_column_for_its_measure(folder):
    page = (folder / "report.html").read_text(encoding="utf-8")
    assert '<h2 id="closest">Closest approach</h2>' in page
    assert "constant:0.5 came as near as" in page
    assert '"title":"closest m"' in page


@pytest.mark.slow
def test_commands_that_read_the_campaign_know_it(folder, merge_sumo):
    assert "closest approach" in merge_sumo("run", "--case", "run", "3", "--vut", "constant:0.5")
    merge_sumo("export", "run", "--format", "endings", "--out", "written")
    lines = (merge_sumo.work / "written" / "endings.jsonl").read_text().splitlines()
    assert len(lines) == 40
    assert json.loads(lines[3])["case"] == 3


def test_records_survive_although_its_measure_has_no_value(merge_sumo):
    """Adding a measure changes its own file alone: tests of records pass as they are."""
    tests = PLUGIN.parent
    said = merge_sumo(
        *("-q", "-n", "0", "-p", "no:cacheprovider", "-k", "record or Record"),
        *(tests / "campaigns/test_journal.py", tests / "verdict/test_chance.py"),
        program=("-m", "pytest"),
    )
    assert " passed" in said
    assert "failed" not in said


@pytest.mark.slow
def test_it_keeps_the_contracts(merge_sumo):
    said = merge_sumo("-q", "-n", "0", PLUGIN, "-p", "no:cacheprovider", program=("-m", "pytest"))
    assert " passed" in said
    assert "skipped" not in said
    assert "failed" not in said
