"""A folder that somebody sent is data: what it names is not run, unless a person says so."""

from __future__ import annotations

import hashlib
import json
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path

import pytest

from merge_sumo.campaigns.conductor import resume_campaign, run_campaign
from merge_sumo.campaigns.run import CHECKSUM, SETTINGS
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import UserError
from merge_sumo.system.trust import SEAL, is_own, seal

TELLTALE = """
import pathlib
pathlib.Path(__file__).with_name("it-ran").touch()
def Vut(seen):
    return {answer}
"""
COMMAND = "{python} -c \"import pathlib; pathlib.Path('{file}').touch()\" {{port}}"


@pytest.fixture(autouse=True)
def of_a_user(tmp_path, monkeypatch):
    """Work as a user with a cache of their own."""
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "mine"))


@pytest.fixture
def stranger(monkeypatch, tmp_path):
    """Return a function after which whoever is here is somebody else."""
    return lambda: monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "theirs"))


@dataclass(frozen=True)
class Made:
    """A campaign of a VUT that leaves a file where it ran."""

    run: Path
    telltale: Path

    def ran(self) -> bool:
        return self.telltale.exists()


def campaign(folder: Path, answer: float = 1.0) -> Made:
    folder.mkdir()
    (folder / "my_vut.py").write_text(TELLTALE.format(answer=answer))
    spec = f"{folder / 'my_vut.py'}:Vut"
    settings = CampaignSettings(vut=spec, levels=(0,), cases=12, batch=6, sampler="uniform")
    return Made(run_campaign(settings, folder / "run").folder, folder / "it-ran")


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> dict[str, Made]:
    """Return two campaigns of one user, whose cache is beside them."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MERGE_SUMO_CACHE", str(folder / "mine"))
        return {
            name: campaign(folder / name, answer) for name, answer in (("one", 1.0), ("two", 2.0))
        }


@pytest.fixture
def copied(made, tmp_path, monkeypatch):
    """Return a function that gives a copy of one of them, made by the user who is here."""
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(made["one"].run.parents[1] / "mine"))

    def copy(name: str = "one") -> Made:
        telltale = made[name].telltale
        telltale.unlink(missing_ok=True)
        return Made(Path(shutil.copytree(made[name].run, tmp_path / name)), telltale)

    return copy


def edit(run: Path, **changes: object) -> None:
    settings = json.loads((run / SETTINGS).read_text())
    settings.pop(CHECKSUM)  # who sends a folder can compute it, too
    (run / SETTINGS).write_text(json.dumps(settings | changes))


def refuses(said: tuple[int, str, str]) -> bool:
    code, _, err = said
    return code == 2 and "--trust-vut" in err and err.count("\n") == 1


def test_what_a_received_folder_names_is_not_run(tmp_path, copied, stranger, command_line):
    one, two = copied("one"), copied("two")
    stranger()
    assert refuses(command_line("campaign", "--resume", one.run, "--quiet"))
    assert refuses(command_line("compare-runs", one.run, two.run))
    assert refuses(
        command_line("probability", one.run, "--cases", 10, "--out", tmp_path / "p.json")
    )
    assert not one.ran()
    assert not two.ran()


def test_reports_exports_and_replays_of_a_received_folder_run_none_of_its_code(
    tmp_path, copied, stranger, command_line
):
    one = copied()
    run = one.run
    stranger()
    out = tmp_path / "out"
    assert command_line("report", run)[0] == 0
    for form in ("sumo", "openscenario", "csv"):
        assert command_line("export", run, 0, "--format", form, "--out", out / form)[0] == 0
    assert command_line("replay", out / "sumo" / "case-00000")[0] == 0
    assert command_line("compare-runs", run, run, "--no-rerun")[0] == 0
    assert not one.ran()


def test_a_person_may_trust_it(copied, stranger):
    one = copied()
    stranger()
    resume_campaign(one.run, trust=True)
    assert one.ran()


def test_who_names_the_controller_again_trusts_it(copied, stranger):
    one = copied()
    vut = json.loads((one.run / SETTINGS).read_text())["vut"]
    stranger()
    resume_campaign(one.run, given={"vut": vut})
    assert one.ran()


def test_a_folder_of_ones_own_goes_on_wherever_it_is(copied):
    one = copied()
    assert len(resume_campaign(one.run).outcomes) == 12
    assert one.ran()


@pytest.mark.parametrize(
    "forged",
    [
        {"vut": "theirs.py:Vut"},
        {"vut": "onnx:theirs.onnx"},
        {"vut": "fmu:theirs.fmu"},
        {"vut": "an_installed_name"},
        {"vut": "traci", "vut_command": "theirs"},
        {"vut": "level0", "vut_command": "theirs"},
        {SEAL: None},
        {SEAL: ""},
        {SEAL: 3},
        {SEAL: ["0"]},
        {SEAL: "\ud800"},
        {SEAL: "größer"},
        {SEAL: "0" * 64},
        {SEAL: hashlib.sha256(b"").hexdigest()},
    ],
)
def test_a_folder_of_ones_own_that_somebody_changed_is_a_strangers(copied, forged):
    one = copied()
    edit(one.run, **forged)
    with pytest.raises(UserError, match=r"--trust-vut|--vut-command goes|not readable JSON"):
        resume_campaign(one.run)
    assert not one.ran()


def test_a_command_in_a_received_folder_is_not_started(tmp_path, copied, stranger, command_line):
    run = copied().run
    file = tmp_path / "started"
    edit(run, vut="traci", vut_command=COMMAND.format(python=sys.executable, file=file))
    stranger()
    assert refuses(command_line("campaign", "--resume", run, "--quiet"))
    into = ("--out", tmp_path / "p.json")
    assert refuses(command_line("probability", run, "--cases", 10, *into))
    assert not file.exists()


@pytest.mark.parametrize("vut", ["level0", "design1", "sumo:IDM"])
def test_what_is_of_this_package_or_of_sumo_runs_from_any_folder(tmp_path, stranger, vut):
    settings = CampaignSettings(vut=vut, levels=(0,), cases=2, batch=2)
    run = run_campaign(settings, tmp_path / "run")
    stranger()
    assert len(resume_campaign(run.folder).outcomes) == 2


def test_the_key_is_the_users_alone_and_stays(tmp_path, stranger):
    settings = {"vut": "my_vut.py:Vut", "vut_command": None}
    first = seal(settings)
    key = tmp_path / "mine" / "key"
    assert key.stat().st_mode & 0o777 == 0o600
    assert [file.name for file in key.parent.iterdir()] == ["key"]
    assert seal(settings) == first
    assert is_own(settings | {SEAL: first})
    assert seal(settings | {"vut": "your_vut.py:Vut"}) != first
    assert seal(settings | {"vut_command": "x"}) != first
    stranger()
    assert not is_own(settings | {SEAL: first})


@pytest.mark.parametrize("torn", [b"", b"short", b"x" * 33])
def test_without_a_key_nothing_is_ones_own(tmp_path, torn):
    settings = {"vut": "my_vut.py:Vut", "vut_command": None}
    sealed = settings | {SEAL: seal(settings)}
    (tmp_path / "mine" / "key").write_bytes(torn)
    assert seal(settings) is None
    assert not is_own(sealed)
    assert not is_own(settings | {SEAL: None})


def test_a_cache_that_cannot_be_written_seals_nothing_and_stops_nobody(tmp_path, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "file"))
    assert seal({"vut": "x"}) is None
    made = campaign(tmp_path / "one")
    with pytest.raises(UserError, match="--trust-vut"):
        resume_campaign(made.run)
