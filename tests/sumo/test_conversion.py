"""Nets of maps: OpenStreetMap and OpenDRIVE, which are data that somebody sent."""

from __future__ import annotations

import json
import math
import os
import re
from pathlib import Path

import pytest
from calling import assert_refused

from merge_sumo.errors import UserError
from merge_sumo.road.merge import road_of
from merge_sumo.road.netfile import NetFile
from merge_sumo.sumo import conversion
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.conversion import command_for, is_map, net_of_map
from merge_sumo.sumo.opendrive import opendrive

NODES = {1: (-1500, 0), 2: (-700, 0), 3: (0, 0), 4: (1500, 0), 5: (-600, -120), 6: (-300, -60)}
WAYS = {10: ([1, 2, 3], "motorway"), 11: ([3, 4], "motorway"), 12: ([5, 6, 3], "motorway_link")}
EDGES = ("--mainline", "10 11", "--ramp", "12 11")


def osm(head: str = "", inside: str = "", tags: str = "") -> str:
    """Return a ramp that joins a motorway of one lane, as OpenStreetMap writes it."""
    lines = [f'<?xml version="1.0" encoding="UTF-8"?>{head}<osm version="0.6">{inside}']
    for name, (x, y) in NODES.items():
        lat, lon = 42.3 + y / 111320, -83.7 + x / (111320 * math.cos(math.radians(42.3)))
        lines.append(f'<node id="{name}" lat="{lat:.7f}" lon="{lon:.7f}" user="a stranger"/>')
    for name, (nodes, kind) in WAYS.items():
        said = {"highway": kind, "lanes": 1, "oneway": "yes"}.items()
        lines.append(f'<way id="{name}">{tags}' + "".join(f'<nd ref="{n}"/>' for n in nodes))
        lines += [f'<tag k="{key}" v="{value}"/>' for key, value in said]
        lines.append("</way>")
    return "\n".join([*lines, "</osm>"])


@pytest.fixture
def here(monkeypatch, tmp_path) -> Path:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "ramp.osm").write_text(osm())
    return tmp_path


@pytest.fixture
def given(monkeypatch) -> list[str]:
    """Note what netconvert is given, and let it run."""
    found: list[str] = []

    def noting(name, arguments, folder, limit_s):
        assert [path.name for path in folder.iterdir()] == ["map.xml"]
        found.append((folder / "map.xml").read_text(encoding="utf-8"))
        return run_program(name, arguments, folder, limit_s)

    monkeypatch.setattr(conversion, "run_program", noting)
    return found


class TestTheCommand:
    def test_makes_a_scenario_of_a_map_of_openstreetmap(self, here, command_line):
        code, out, err = command_line("scenario", "new", "a.toml", "--net", "ramp.osm", *EDGES)
        assert (code, err) == (0, "")
        assert "its net a.net.xml, made of ramp.osm" in out
        assert sorted(p.name for p in here.iterdir()) == [
            "a.net.xml",
            "a.svg",
            "a.toml",
            "ramp.osm",
        ]
        code, out, err = command_line("scenario", "check", "a.toml")
        assert (code, err) == (0, "")
        assert "mainline: 10 11, 1504" in out

    def test_makes_one_of_opendrive_and_a_case_runs(self, here, command_line):
        (here / "us23.xodr").write_bytes(opendrive(road_of()))
        edges = ("--mainline", "-40 -41", "--ramp", "-42 -41")
        code, out, err = command_line("scenario", "new", "b.toml", "--net", "us23.xodr", *edges)
        assert (code, err) == (0, "")
        assert "its net b.net.xml, made of us23.xodr" in out
        case = ("--x", -260, "--v", 30, "--scenario", "b.toml", "--json")
        code, out, err = command_line("run", "--vut", "level0", *case)
        assert (code, err) == (0, "")
        assert json.loads(out)["end"] == "MERGED"

    @pytest.mark.parametrize(
        ("unit", "mps"), [("m/s", 45.0), ("km/h", 12.5), ("mph", 20.12), ("", 45.0)]
    )
    def test_takes_the_units_of_speed_of_opendrive(self, here, unit, mps):
        map_file = here / "us23.xodr"
        text = opendrive(road_of()).decode()
        map_file.write_text(text.replace('max="45.000000"', f'max="45" unit="{unit}"'))
        (lane,) = NetFile(map_file, net_of_map(map_file)).lanes("-42")
        assert lane.speed_limit_mps == pytest.approx(mps, abs=0.01)

    def test_says_which_edges_there_are_and_writes_nothing(self, here, command_line):
        asked = ("scenario", "new", "a.toml", "--net", "ramp.osm")
        assert_refused(
            command_line(*asked, "--mainline", "10 11x", "--ramp", "12 11"),
            "the net ramp.osm cannot host a merge: it has no edge 11x: did you mean 11?",
            "it has 10, 11, 12",
            "`netconvert --osm-files ramp.osm ",
        )
        assert [path.name for path in here.iterdir()] == ["ramp.osm"]

    @pytest.mark.parametrize("taken", ["a.net.xml", "a.svg", "a.toml"])
    @pytest.mark.parametrize("how", ["file", "dangling link"])
    def test_replaces_nothing(self, here, command_line, taken, how):
        if how == "file":
            (here / taken).write_text("mine")
        else:
            (here / taken).symlink_to(here / "elsewhere")
        before = sorted(path.name for path in here.iterdir())
        assert_refused(
            command_line("scenario", "new", "a.toml", "--net", "ramp.osm", *EDGES),
            f"{taken} exists",
        )
        assert sorted(path.name for path in here.iterdir()) == before


def test_maps_are_known_by_their_names():
    assert all(map(is_map, map(Path, ("a.osm", "a.osm.xml", "A.OSM", "b/a.xodr"))))
    assert not any(map(is_map, map(Path, ("a.net.xml", "osm", "a.osm.pbf", "a.toml"))))
    assert command_for(Path("a b.xodr")).startswith("netconvert --opendrive-files 'a b.xodr' ")


class TestAHostileMap:
    @pytest.mark.parametrize(
        ("content", "said"),
        [
            (osm('<!DOCTYPE osm SYSTEM "http://127.0.0.1:9/x.dtd">'), "declares a document type"),
            (osm('<!DOCTYPE osm [<!ENTITY x SYSTEM "file:///etc/passwd">]>'), "document type"),
            ("<configuration><input/></configuration>", "another root than <osm>"),
            ("<osm><node id='1' lat='nan' lon='0'/></osm>", "lat"),
            ("<osm><node id='x' lat='0' lon='0'/></osm>", "id"),
            ("<osm><node id='1' lat='0'/></osm>", "lon"),
            ("no XML", "is not readable XML"),
            ("", "is not readable XML"),
            ("<osm version='0.6'></osm>", "netconvert makes no net|cannot host|no edge"),
            (f"<osm>{'<a>' * 300}", "is not readable XML"),
        ],
        ids=["DTD", "entity", "root", "NaN", "id", "missing", "text", "empty", "no roads", "deep"],
    )
    def test_is_refused_in_a_sentence(self, here, command_line, content, said):
        (here / "evil.osm").write_text(content)
        code, out, err = command_line("scenario", "new", "a.toml", "--net", "evil.osm", *EDGES)
        assert (code, out, err.count("\n")) == (2, "", 1), err
        assert re.search(said, err), err
        assert not list(here.glob("a.*"))

    @pytest.mark.parametrize("kind", ["pipe", "folder", "device", "nothing"])
    def test_that_is_no_file_is_refused(self, here, command_line, kind):
        path = here / "evil.osm"
        if kind == "pipe":
            os.mkfifo(path)
        elif kind == "folder":
            path.mkdir()
        elif kind == "device":
            path.symlink_to("/dev/zero")
        assert_refused(
            command_line("scenario", "new", "a.toml", "--net", "evil.osm", *EDGES),
            "cannot read the map evil.osm",
        )

    def test_gives_netconvert_only_what_a_road_needs(self, here, given):
        hostile = '<include file="/etc/passwd"/><note href="http://127.0.0.1:9/">x</note>'
        (here / "evil.osm").write_text(osm(inside=hostile, tags='<link file="/etc/shadow"/>'))
        assert net_of_map(Path("evil.osm")) == net_of_map(Path("ramp.osm"))
        assert "motorway_link" in given[0]
        for word in ("include", "passwd", "shadow", "127.0.0.1", "stranger", "file="):
            assert word not in given[0]

    def test_in_opendrive_names_no_files_by_its_projection(self, here, given):
        plain = opendrive(road_of()).decode()
        hostile = plain.replace(
            "</header>",
            "<geoReference><![CDATA[+proj=utm +nadgrids=/etc/passwd +zone=17]]></geoReference>"
            '<include file="/etc/passwd"/><userData code="x" value="/etc/passwd"/></header>',
            1,
        )
        assert hostile != plain or "<header" in plain
        (here / "evil.xodr").write_text(hostile)
        assert b"<net " in net_of_map(Path("evil.xodr"))
        for word in ("geoReference", "nadgrids", "passwd", "include", "userData"):
            assert word not in given[0]

    def test_on_which_netconvert_spends_too_long_is_given_up(self, here, monkeypatch):
        monkeypatch.setattr(conversion, "CONVERT_LIMIT_S", 0.001)
        with pytest.raises(UserError, match=r"it did not end within 0\.001 s"):
            net_of_map(Path("ramp.osm"))
