"""Spoilt, foreign and hostile data: found out and named, or without effect; never believed."""

from __future__ import annotations

import csv
import io
import json
import math
import os
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import some
from lxml import etree
from support.calling import assert_refused
from support.handmade import write_run
from support.plans import key_of, plan_for
from support.writers import PLACES

import merge_sumo as ms
from merge_sumo.analysis.truth import Truth, ground_truth, read_truth
from merge_sumo.api import open_run
from merge_sumo.campaigns.run import OUTCOMES, SETTINGS, TRAJECTORIES, read_settings
from merge_sumo.controllers.process import LOG
from merge_sumo.errors import UserError
from merge_sumo.metrics.merge import Severity
from merge_sumo.reports.junit import write_junit
from merge_sumo.reports.report import REPORT
from merge_sumo.scenario.scenario import US23


@pytest.fixture
def copied(run, tmp_path) -> Path:
    return Path(shutil.copytree(run.folder, tmp_path / "run"))


class TestWhatWasChanged:
    @pytest.mark.parametrize("name", [SETTINGS, OUTCOMES, f"{TRAJECTORIES}/00000.npz"])
    def test_into_a_pipe_is_not_waited_for(self, command_line, copied, name):
        (copied / name).unlink()
        os.mkfifo(copied / name)
        assert_refused(command_line("export", copied, 0), "it is not a file")


CASES = 30
KEPT = key_of(cases=CASES)


def saved(**changes: Any) -> bytes:
    """Return a file of the cache with some arrays replaced, or left out where they are None."""
    rng = np.random.default_rng(5)
    arrays = {
        "points": rng.random((CASES, 2)),
        "margin": rng.random(CASES) - 0.5,
        "in_sumo": CASES,
        "files": "{}",
        "of": KEPT.path().stem,
        **changes,
    }
    content = io.BytesIO()
    np.savez(content, **{name: array for name, array in arrays.items() if array is not None})
    return content.getvalue()


def compressed(size: int) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, points=np.zeros(size), margin=np.zeros(1), files="{}", of="x")
    return content.getvalue()


SPOILT = {
    "empty": b"",
    "text": b"points and margins",
    "a pickle": saved(points=np.full((CASES, 2), None)),
    "of another truth": saved(of="truth-0123456789abcdef01234567"),
    "too many points": saved(points=np.zeros((CASES + 1, 2))),
    "margins that are too few": saved(margin=np.zeros(CASES - 1)),
    "a bomb of 800 MB": compressed(10**8),
    **{
        f"files that are {text[:30]!r}": saved(files=text)
        for text in ("[]", '{"/dev/zero": "0"}', "[" * 100_000)
    },
}


@pytest.fixture(scope="module")
def true(tmp_path_factory) -> tuple[Truth, bytes]:
    """Return what is true of design 1 at level 0 in a few cases, and its file in the cache."""
    folder = tmp_path_factory.mktemp("true")
    return ground_truth(plan_for("design1"), 0, CASES, cache=folder), KEPT.path(folder).read_bytes()


class TestACache:
    @pytest.mark.parametrize("name", SPOILT)
    def test_that_is_spoilt_is_not_believed(self, name, tmp_path):
        KEPT.path(tmp_path).write_bytes(SPOILT[name])
        assert read_truth(KEPT.path(tmp_path), 0, CASES, US23) is None

    def test_as_these_would_be_believed_is_what_the_test_spoils(self, tmp_path):
        path = KEPT.path(tmp_path)
        path.write_bytes(saved())
        assert read_truth(path, 0, CASES, US23) is not None

    @pytest.mark.parametrize("how", ["others can write", "belongs to"])
    def test_that_somebody_else_may_have_written_is_not_used(
        self, true, tmp_path, monkeypatch, how
    ):
        """As a shared cache was overwritten with "no failures"."""
        KEPT.path(tmp_path).write_bytes(true[1])
        if how == "belongs to":
            monkeypatch.setattr(os, "geteuid", lambda: 12345)
        else:
            tmp_path.chmod(0o777)
        assert read_truth(KEPT.path(tmp_path), 0, CASES, US23) is None
        with pytest.raises(UserError, match=f"is not used: .*{how} "):
            ground_truth(plan_for("design1"), 0, CASES, cache=tmp_path)

    @pytest.mark.parametrize("kind", ["a folder", "a link to a file", "a pipe"])
    def test_with_no_file_there_is_refused_in_a_sentence(self, kind, tmp_path):
        (tmp_path / "theirs").mkdir()
        (tmp_path / "theirs" / "thesis").write_text("theirs")
        path = KEPT.path(tmp_path)
        PLACES[kind](path)
        assert read_truth(path, 0, CASES, US23) is None
        with pytest.raises(UserError, match="cannot write"):
            ground_truth(plan_for("design1"), 0, CASES, cache=tmp_path)
        assert (tmp_path / "theirs" / "thesis").read_text() == "theirs"


MARKUP = "<script>alert(1)</script></script><!--<img src=x onerror=alert(1)>]]>&amp;"
TEXTS = {
    "markup": MARKUP,
    "ANSI": "\x1b[2J\x1b[31mred\x1b]0;title\x07\x9b5n\r\b\n\n",
    "every control": "".join(map(chr, [*range(32), *range(127, 160), 0x202E, 0x2028, 0xFEFF])),
    "a formula": "=cmd|'/c calc'!A1",
    "10 MB of markup": MARKUP * 130_000,
    "a template": "{{ 7 * 7 }} {% include '/etc/passwd' %} ${7*7} %s %n",
}


@pytest.fixture(scope="module")
def honest(tmp_path_factory) -> Path:
    """Return a folder of 40 cases with an error."""
    folder = tmp_path_factory.mktemp("honest") / "run"
    write_run(folder, per_level=20, levels=(0, 2), errors={7: "answered nan", 39: "answered nan"})
    return folder


def received(honest: Path, folder: Path, text: str) -> Path:
    """Return a run of a stranger's who says something in errors and as the name of the VUT."""
    shutil.copytree(honest, folder)
    lines = (folder / OUTCOMES).read_text().splitlines()
    for index in (7, 39):
        lines[index] = json.dumps(json.loads(lines[index]) | {"error": text})
    (folder / OUTCOMES).write_text("\n".join(lines) + "\n")
    (folder / SETTINGS).write_text(json.dumps(read_settings(folder) | {"vut": text}))
    (folder / LOG).write_text(text[:100_000])
    return folder


def assert_fit_for_a_terminal(said: str) -> None:
    assert "Traceback" not in said
    assert len(said) < 100_000
    assert all(letter.isprintable() or letter in " \n\u3000" for letter in said), said[:500]


@pytest.fixture(scope="module")
def usual(honest, tmp_path_factory) -> bytes:
    """Return the report of a run in which nobody says anything odd."""
    folder = received(honest, tmp_path_factory.mktemp("usual") / "run", "answered nan")
    ms.report(folder)
    return (folder / REPORT).read_bytes()


@pytest.mark.parametrize("name", some(TEXTS, "every control", "markup"))
class TestATextOfAStranger:
    def test_stays_a_text_in_the_report_and_on_the_terminal(
        self, command_line, name, honest, usual, tmp_path
    ):
        folder = received(honest, tmp_path / "run", TEXTS[name])
        code, out, err = command_line("report", folder)
        assert code == 0, err
        assert_fit_for_a_terminal(out + err)
        page = (folder / REPORT).read_bytes()
        assert len(page) < len(usual) + 1_000_000
        for tag in (b"<script", b"</script", b"<img", b"<!--", b"\0", b"\x1b"):
            assert page.count(tag) == usual.count(tag), tag
        assert b"49 {%" not in page

    def test_is_in_no_table_and_leaves_xml_readable(self, command_line, name, honest, tmp_path):
        folder = received(honest, tmp_path / "run", TEXTS[name])
        code, _, err = command_line("export", folder, "--format", "csv", "--out", tmp_path / "t")
        assert code == 0, err
        with (tmp_path / "t" / "trajectories.csv").open(newline="") as file:
            header, *rows = csv.reader(file)
        assert all(name.replace("_", "").isalnum() for name in header)
        assert len(rows) > 40
        assert header[-1] == "severity"
        assert {row[-1] for row in rows} <= {"", *Severity}
        assert all(math.isfinite(float(cell or 0)) for row in rows for cell in row[:-1])
        code, _, err = command_line(
            "export", folder, 7, "--format", "openscenario", "--out", tmp_path / "xosc"
        )
        assert code == 0, err
        written = [*(tmp_path / "xosc").rglob("*.xosc")]
        assert len(written) == 2, "as recorded, and with a free ego"
        assert {etree.parse(xosc).getroot().tag for xosc in written} == {"OpenSCENARIO"}
        opened = open_run(folder)
        write_junit(tmp_path / "junit.xml", opened.run, opened.facts, opened.verdict, [])
        assert etree.parse(tmp_path / "junit.xml").getroot().tag == "testsuites"
        notebook = open_run(folder)._repr_html_() + open_run(folder).errors._repr_html_()
        assert "<script" not in notebook
        assert len(notebook) < 100_000
