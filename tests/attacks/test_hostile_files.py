"""Files of others are data, whatever they hold.

Each row of the table changes one thing in an honest file. SUMO itself is real.
"""

from __future__ import annotations

import os
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.plans import plan_for
from support.processes import cpu_s
from support.writers import tree

import merge_sumo as ms
from merge_sumo.analysis.truth import ground_truth, known_truth, truth_path
from merge_sumo.campaigns.recorded import OUTCOMES, SETTINGS
from merge_sumo.errors import UserError
from merge_sumo.road import xml_input
from merge_sumo.road.loader import default_net_path, road_of
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo import mirror, replay_folder
from merge_sumo.sumo import replay as replay_module
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.opendrive import opendrive
from merge_sumo.sumo.replay import replay
from merge_sumo.sumo.replay_folder import CONFIG, RECORD
from merge_sumo.sumo.sumo_simulation import SumoSimulation

HONEST = Path(__file__).resolve().parents[2] / "scenarios" / "roundabout-yields"
LIMIT_S = 20.0
"""Of CPU time."""
SECRET = "what-only-the-user-knows"  # noqa: S105 (of no account)
PLAN = plan_for("design1")
TRUTH = truth_path(PLAN, 0, 30).name

Change = Callable[[Path], object]


def play(root: Path) -> str:
    return replay(root / "sent").lines()[-1].partition(":")[0]


def host(root: Path) -> str:
    """Use a net with every kind of controller and in an export; return the files made of it."""
    road = road_of(root / "sent" / "net.xml")
    with SumoSimulation(1, road, scenario=US23) as simulation:
        simulation.advance()
    with tempfile.TemporaryDirectory() as folder:
        mirror.write_files(Path(folder), road, US23)
        mirrored = (Path(folder) / mirror.NET).read_text()
    return f"hosted {mirrored} {opendrive(road).decode()}"


def export(root: Path) -> object:
    return ms.export(root / "sent", [0])


def believe(root: Path) -> str:
    truth = known_truth(PLAN, 0, 30, cache=root / "sent")
    return "not believed" if truth is None else "believed"


def instead(old: str, new: str) -> Change:
    """Replace the first match of a pattern; `~` is the folder of the user."""

    def change(path: Path) -> None:
        text = path.read_text(encoding="utf-8")
        hostile = re.sub(old, new.replace("~", str(path.parents[1] / "home")), text, count=1)
        assert hostile != text
        path.write_text(hostile, encoding="utf-8")

    return change


def first(text: str) -> Change:
    """Put text behind the start tag of the root."""
    return instead(r"<\w[^>]*>", rf"\g<0>{text}")


def declared(entities: str) -> Change:
    return instead(r"<(?=\w)", f"<!DOCTYPE l [{entities}]><")


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def link(path: Path) -> None:
    path.unlink()
    path.symlink_to("../home/secret.xml")


def in_utf_16(path: Path) -> None:
    path.write_text(path.read_text(), encoding="utf-16")


def of_a_terabyte(path: Path) -> None:
    os.truncate(path, 2**40)


def truth(save: Callable[..., object] = np.savez, **changes: object) -> Change:
    """Write a file of the cache with some arrays replaced."""

    def change(path: Path) -> None:
        arrays = {"points": np.zeros((30, 2)), "margin": np.zeros(30), "in_sumo": 30}
        save(path, **{**arrays, "files": "{}", "of": path.stem, **changes})

    return change


NET = "net.xml"
LAUGHS = "".join(f"<!ENTITY a{n} '{f'&a{n - 1};' * 10}'>" for n in range(1, 10))
LOG = (
    '<tlLogic id="M" type="actuated" programID="0" offset="0"><param key="file" value="~/thesis"/>'
    '<phase duration="9" state="G"/></tlLogic>'
)
INCLUDE = '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="~/secret.xml"/>'
DECLARES = "declares a document type or an entity"
ATTACKS = {
    # Additions have no effect.
    "detector": (NET, first('<e2Detector lane="a" file="~/thesis"/>'), host, "hosted"),
    "light with a log": (NET, first(LOG), host, "hosted"),
    "projection": (NET, instead('"!"', '"+proj=utm +nadgrids=~/secret.xml"'), host, "hosted"),
    "schema": (NET, instead("http://[^ ]*net_file.xsd", "http://~"), host, "hosted"),
    "XInclude": (RECORD, first(INCLUDE), play, "identical"),
    "configuration": (CONFIG, first('<log value="~/thesis"/>'), play, "identical"),
    # Not the content that it seems.
    "billion laughs": (NET, declared(f"<!ENTITY a0 'ha'>{LAUGHS}"), host, DECLARES),
    "entity": (RECORD, declared('<!ENTITY a SYSTEM "file://~/secret.xml">'), play, DECLARES),
    "elements": (NET, first('<edge id="e"/>' * 5001), host, "has more than 5000 elements"),
    "depth": (NET, first("<a>" * 1000), host, "is not readable XML"),
    "UTF-16": (RECORD, in_utf_16, play, "save it as UTF-8"),
    "far time": (RECORD, instead('time="0.10"', 'time="9e99"'), play, "missing or wrong value"),
    # Not the file that it seems.
    "long name": (SETTINGS, instead("design1", "<script>" * 10**6), export, "at most 10,000"),
    "pipe of outcomes": (OUTCOMES, pipe, export, "it is not a file"),
    "terabyte": (replay_folder.NET, of_a_terabyte, play, "it is larger than"),
    "link to a secret": (RECORD, link, play, "must have"),
    # The cache of truths.
    "truth": (TRUTH, truth(), believe, "believed"),
    "pickle": (TRUTH, truth(points=np.full((30, 2), None)), believe, "not believed"),
    "another truth": (TRUTH, truth(of="truth-0123"), believe, "not believed"),
    "bomb": (TRUTH, truth(np.savez_compressed, more=np.zeros(10**7)), believe, "not believed"),
    "device": (TRUTH, truth(files='{"/dev/zero": "0"}'), believe, "not believed"),
}
"""File, hostile content, the verb that reads it, and how its result begins or what refuses it."""


@pytest.fixture
def root(run, tmp_path, monkeypatch) -> Path:
    """Plant the files of a user and those that were sent, and look at what SUMO is started on."""
    (tmp_path / "home").mkdir()
    (tmp_path / "home" / "thesis").write_text("ten years of work")
    (tmp_path / "home" / "secret.xml").write_text(f"<{SECRET}>{SECRET}</{SECRET}>")
    for folder in (run.folder, HONEST):
        shutil.copytree(folder, tmp_path / "sent", dirs_exist_ok=True)
    (tmp_path / "sent").chmod(0o700)
    shutil.copy(default_net_path(), tmp_path / "sent" / NET)
    monkeypatch.setattr(xml_input, "MAX_ELEMENTS", 5000)

    def looked_at(name: str, arguments: list[str], stage: Path, **options: Any) -> object:
        for path in stage.iterdir():
            text = path.read_text(encoding="utf-8")
            assert not [word for word in (str(tmp_path / "home"), SECRET, "//") if word in text]
        return run_program(name, arguments, stage, **options)

    monkeypatch.setattr(replay_module, "run_program", looked_at)
    return tmp_path


@pytest.mark.parametrize("name", ATTACKS)
def test_a_hostile_file_does_nothing_and_gets_a_sentence_or_a_true_result(root, name):
    file, change, verb, expected = ATTACKS[name]
    change(root / "sent" / file)
    before, before_s = tree(root), cpu_s()
    try:
        result = str(verb(root))
        assert result.startswith(expected)
    except UserError as error:
        result = str(error)
        assert expected in result
        assert "\n" not in result
        assert len(result) < 1000
    assert SECRET not in result
    assert str(root / "home") not in result
    assert cpu_s() - before_s < LIMIT_S
    assert tree(root) == before


@pytest.mark.parametrize("how", ["others can write", "belongs to"])
def test_a_cache_that_another_user_may_have_written_is_not_used(tmp_path, monkeypatch, how):
    """As a shared cache was overwritten with "no failures"."""
    truth()(tmp_path / TRUTH)
    if how == "belongs to":
        monkeypatch.setattr(os, "geteuid", lambda: 12345)
    else:
        tmp_path.chmod(0o777)
    assert known_truth(PLAN, 0, 30, cache=tmp_path) is None
    with pytest.raises(UserError, match=f"is not used: .*{how} "):
        ground_truth(PLAN, 0, 30, cache=tmp_path)
