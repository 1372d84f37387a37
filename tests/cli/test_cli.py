"""The command line: what it prints where, how it ends, and what it leaves alone."""

# mypy: no-strict-optional

from __future__ import annotations

import importlib
import json
import shutil
from pathlib import Path

import pytest
from lxml import etree
from support.calling import Said, assert_refused, commands, contents, invoke, run_in_a_process

from merge_sumo.analysis.reproduction import TABLE_II, Scale
from merge_sumo.campaigns.recorded import RecordedCampaign, failures, spread_failures
from merge_sumo.sumo.binding import DEBIAN_PACKAGES
from merge_sumo.sumo.replay_folder import RECORD

COMMANDS = [name for name in commands() if " " not in name]
SMALL = ("campaign", "--vut", "design1", "--level", "0")
GPR = ("--sampler", "gpr")


@pytest.fixture
def campaign(run, tmp_path) -> Path:
    """Return a copy of the finished campaign."""
    return Path(shutil.copytree(run.folder, tmp_path / "campaign"))


@pytest.fixture
def scenario(run, tmp_path) -> Path:
    """Return a copy of an exported failure."""
    (first, *_) = sorted((run.folder / "scenarios").iterdir())
    return Path(shutil.copytree(first, tmp_path / "scenario"))


def diverge(scenario: Path) -> None:
    """Let the record of a scenario have a speed at which the vehicle does not move."""
    record = etree.parse(scenario / RECORD)
    vehicle = record.findall("timestep")[20][1]
    vehicle.set("speed", str(float(vehicle.get("speed")) + 1.0))
    record.write(scenario / RECORD)


class TestACampaignThatCannotRunIsRefusedInOneSentence:
    @pytest.mark.parametrize(
        ("arguments", "parts"),
        [
            (("--vut", "design9"), ("'design9'", "design1", "level0")),
            (("--level", "3"), ("'3'", "0, 1, 2, all")),
            (("--cases", "0"), ("--cases is 0",)),
            (("--gate", "failure"), ("choose failures",)),
            (("--workers", "two"), ("'two'", "tcp://HOST:PORT")),
            (("--sampler", "grp"), ("'grp'", "gpr", "uniform")),
        ],
        ids=" ".join,
    )
    def test_for_its_settings(self, call, tmp_path, arguments, parts):
        before = contents(tmp_path)
        others = [option for option in (SMALL[1:3], SMALL[3:5]) if option[0] not in arguments]
        assert_refused(call(SMALL[0], *sum(others, ()), "--out", "run", *arguments), *parts)
        assert contents(tmp_path) == before

    @pytest.mark.parametrize(
        ("error", "parts"),
        [
            (
                ImportError("libGL.so.1: cannot open shared object file: No such file"),
                ("libGL.so.1", "apt-get install", DEBIAN_PACKAGES),
            ),
            (ModuleNotFoundError("No", name="libsumo"), ("pip install libsumo==",)),
        ],
    )
    def test_for_libsumo_that_cannot_be_loaded(self, call, tmp_path, monkeypatch, error, parts):
        cannot_import(monkeypatch, "libsumo", error)
        before = contents(tmp_path)
        assert_refused(call(*SMALL, "--cases", 4, "-q", "--out", "run", "--workers", 1), *parts)
        assert contents(tmp_path) == before

    def test_for_the_libsumo_of_another_sumo(self, call, monkeypatch):
        import libsumo

        monkeypatch.setattr(libsumo, "getVersion", lambda: (21, "SUMO 1.18.0"))
        said = call(*SMALL, "--cases", 4, "-q", "--out", "run", "--workers", 1)
        assert_refused(said, "libsumo has SUMO 1.18.0", "pip install --force-reinstall")


def cannot_import(monkeypatch, module: str, error: ImportError) -> None:
    """Let the import of one module by name fail."""
    import_module = importlib.import_module

    def refuse(name: str, package: str | None = None):
        if name == module:
            raise error
        return import_module(name, package)

    monkeypatch.setattr(importlib, "import_module", refuse)


@pytest.fixture(scope="module")
def ended(tmp_path_factory) -> tuple[Path, Said]:
    """Return where a campaign of 80 cases ran in a process of its own, and what it said."""
    folder = tmp_path_factory.mktemp("ended")
    arguments = ("--cases", 80, "--seed", 1, *GPR, "--out", "run", "--json")
    return folder, run_in_a_process(folder, *SMALL, *arguments)


class TestACampaign:
    def test_writes_a_line_per_case_and_prints_exactly_one_json_object(self, ended):
        folder, said = ended
        assert (said.code, said.out.count("\n")) == (0, 1), said.err
        run = RecordedCampaign(folder / "run")
        assert [o.batch for o in run.outcomes] == [index // 40 for index in range(80)]
        assert (folder / "run" / "outcomes.jsonl").read_bytes().count(b"\n") == 80
        summary, found = json.loads(said.out), len(failures(run.outcomes))
        assert (summary["cases"], summary["failures"]) == (80, found)
        assert summary["levels"]["0"]["failures"] == found
        # One ball of radius 0.05 has 0.00785.
        assert 0.0078 < summary["levels"]["0"]["fmc"] <= found * 0.0079
        assert (folder / summary["report"]).is_file()
        assert (folder / summary["run"]).is_dir()

    def test_exports_its_worst_failures_as_scenarios_that_replay_identically(self, ended, call):
        folder, _ = ended
        worst = spread_failures(RecordedCampaign(folder / "run").outcomes)[:10]
        names = {f"case-{outcome.index:05d}" for outcome in worst}
        assert {path.name for path in (folder / "run" / "scenarios").iterdir()} == names
        for name in sorted(names)[:3]:
            said = call("replay", folder / "run" / "scenarios" / name)
            assert (said.code, said.err) == (0, "")
            assert "\nidentical" in said.out


def test_replay_prints_exactly_one_json_object(call, scenario):
    for code, diverged_at_s in ((0, None), (1, 2.0)):
        said = call("replay", scenario, "--json")
        assert (said.code, said.out.count("\n")) == (code, 1)
        assert json.loads(said.out)["identical"] is (code == 0)
        assert json.loads(said.out)["diverged_at_s"] == diverged_at_s
        diverge(scenario)
    assert "\ndiverged at t = 2.0 s" in call("replay", scenario).out


class TestHelp:
    def test_says_how_to_start_and_names_every_command_and_the_version(self):
        said = invoke("--help").output
        assert invoke("-h").output == said
        assert "merge-sumo campaign --vut" in said
        assert all(name in said for name in COMMANDS)
        assert invoke("--version").output.startswith("merge-sumo ")


def test_benchmark_prints_one_json_object_with_the_promised_keys_and_draws(
    call, tmp_path, monkeypatch
):
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "cache"))
    code, out, err = call(
        *("benchmark", "--vut", "design1", "--level", 0, "--truth-cases", 300, "--workers", 1),
        *("--samplers", "uniform,gpr", "--seeds", 2, "--cases", 30, "--batch", 15),
        *("--json", "--figure", "curves.svg"),
    )
    assert code == 0, err
    assert out.count("\n") == 1
    found = json.loads(out)
    assert 0.0 < found["truth_fmc"] <= found["limit_fmc"]
    assert found["dense_fmc"] == {}
    for name in ("uniform", "gpr"):
        assert set(found["samplers"][name]["fmc"]) == {"median", "low", "high"}
    assert (tmp_path / "curves.svg").read_text().count("<svg") == 1


def test_reproduce_prints_the_table_and_where_the_rest_is(call, tmp_path, monkeypatch):
    scale = Scale(seeds=1, truth_cases=(100, 100, 100), batches=1, batch=6)
    monkeypatch.setattr("merge_sumo.analysis.reproduction.QUICK", scale)
    monkeypatch.setattr("merge_sumo.analysis.reproduction.TABLE_II", TABLE_II[:1])
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "cache"))
    code, out, err = call("reproduce", "--quick", "--workers", 1, "--out", "here")
    assert code == 0, err
    assert out.startswith("| FMC: ours (the paper's) |")
    assert "here/index.html" in out.splitlines()[-1]


def test_an_error_in_a_process_of_its_own_is_one_sentence_without_a_traceback(tmp_path):
    assert_refused(run_in_a_process(tmp_path, "replay", "nowhere"), "nowhere")
