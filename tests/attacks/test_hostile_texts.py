"""Texts of others, in errors, names and logs, stay texts in everything that is made of them."""

from __future__ import annotations

import csv
import json
import math
import shutil
from pathlib import Path

import pytest
from lxml import etree
from support.handmade import write_run

import merge_sumo as ms
from merge_sumo.api import open_run
from merge_sumo.campaigns.recorded import OUTCOMES, SETTINGS, read_settings
from merge_sumo.controllers.process import LOG
from merge_sumo.metrics.merge import Severity
from merge_sumo.reports.junit import write_junit
from merge_sumo.reports.report import REPORT

CONTROLS = "".join(map(chr, [*range(32), *range(127, 160), 0x202E, 0x2028, 0xFEFF]))
TEXTS = {
    "markup": "<script>alert(1)</script></script><!--<img src=x onerror=alert(1)>]]>&amp;",
    "controls": f"\x1b[2J\x1b[31mred\x1b]0;title\x07{CONTROLS}",
    "formula": "=cmd|'/c calc'!A1",
    "template": "{{ 7 * 7 }} {% include '/etc/passwd' %} ${7*7} %s %n",
}


@pytest.fixture(scope="module")
def honest(tmp_path_factory) -> Path:
    """Return a reported folder of 40 cases with two errors."""
    folder = tmp_path_factory.mktemp("honest") / "run"
    write_run(folder, per_level=20, levels=(0, 2), errors={7: "answered nan", 39: "answered nan"})
    ms.report(folder)
    return folder


@pytest.mark.parametrize("name", TEXTS)
def test_a_text_of_another_user_stays_a_text(call, name, honest, tmp_path):
    folder = Path(shutil.copytree(honest, tmp_path / "run"))
    text = TEXTS[name]
    lines = (folder / OUTCOMES).read_text().splitlines()
    for index in (7, 39):
        lines[index] = json.dumps(json.loads(lines[index]) | {"error": text})
    (folder / OUTCOMES).write_text("\n".join(lines) + "\n")
    (folder / SETTINGS).write_text(
        json.dumps(read_settings(folder) | {"vut": text, "sampler": text})
    )
    (folder / LOG).write_text(text)

    code, out, err = call("report", folder)
    assert code == 0, err
    assert all(letter.isprintable() or letter in " \n\u3000" for letter in out + err)
    page, usual = (folder / REPORT).read_bytes(), (honest / REPORT).read_bytes()
    for tag in (b"<script", b"</script", b"<img", b"<!--", b"\0", b"\x1b"):
        assert page.count(tag) == usual.count(tag), tag
    assert b"49 {%" not in page

    code, _, err = call("export", folder, "--format", "csv", "--out", "tables")
    assert code == 0, err
    with (tmp_path / "tables" / "trajectories.csv").open(newline="") as file:
        header, *rows = csv.reader(file)
    assert all(column.replace("_", "").isalnum() for column in header)
    assert len(rows) > 40
    for *numbers, severity in rows:
        assert severity in ("", *Severity)
        assert all(math.isfinite(float(number or 0)) for number in numbers)

    code, _, err = call("export", folder, 7, "--format", "openscenario", "--out", "xosc")
    assert code == 0, err
    written = [*(tmp_path / "xosc").rglob("*.xosc")]
    assert len(written) == 2, "as recorded, and with a free ego"
    assert {etree.parse(file).getroot().tag for file in written} == {"OpenSCENARIO"}
    opened = open_run(folder)
    write_junit(tmp_path / "junit.xml", opened)
    assert etree.parse(tmp_path / "junit.xml").getroot().tag == "testsuites"
    assert "<script" not in opened._repr_html_()
