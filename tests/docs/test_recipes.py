"""The recipes of the pages: all are applied to a copy of the package, and what they add runs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from docs_pages import ROOT

PAGES = ("CONTRIBUTING.md", "docs/how-to/extend.md")
NEW = {
    "samplers/corner.py": """
from merge_sumo.samplers.base import LevelwiseSampler


class Corner(LevelwiseSampler):
    about = "draws from a corner of the pool"
    colour = "#994F00"
    learns = False

    def propose(self, history, n, rng, level):
        return 0.5 * rng.random((n, history.dims))
""",
    "drivers/cruise.py": """
from dataclasses import dataclass

import numpy as np

from merge_sumo.drivers.base import BuiltInVut, Design, Driver


@dataclass(frozen=True, kw_only=True, slots=True)
class CruiseDesign(Design):
    v_mps: float = 28.0
    gain_per_s: float = 1.0


class Cruise(Driver):
    def __init__(self, corridors, design):
        super().__init__(corridors)
        self._design = design

    def begin(self, corridor, case):
        pass

    def act(self, scene):
        a_mps2 = self._design.gain_per_s * (self._design.v_mps - scene.v_vut_mps)
        return np.clip(a_mps2, -4.0, 1.0)


VUTS = {"cruise": BuiltInVut(Cruise, CruiseDesign())}
""",
    "controllers/hold.py": """
from merge_sumo.controllers.controller import Controller
from merge_sumo.controllers.spec import ControllerKind


class HoldKind(ControllerKind):
    form, what = "hold:START?a_mps2=A&until_s=T", "accelerates for a while"

    def __init__(self, spec, options):
        super().__init__(spec, options)
        self.settable = {"a_mps2": 1.0, "until_s": 2.0} | spec.numbers()

    def controller(self):
        return HoldController(**self.settable)


class HoldController(Controller):
    def __init__(self, a_mps2, until_s):
        self.a_mps2, self.until_s = a_mps2, until_s

    def act(self, seen):
        return self.a_mps2 if seen.t_s < self.until_s else 0.0
""",
    "reports/templates/sections/thanks.html.jinja": """<section aria-labelledby="thanks">
<h2 id="thanks">Thanks</h2><p>{{ vut }} drove {{ run.outcomes | length }} cases.</p>
</section>
""",
}
"""Files that recipes add."""
MORE = {
    "metrics/measures.py": {
        "    @measure()\n    def end(": '''    @measure(unit="m", missing=0.0)
    def last_m(self) -> float:
        """Position of the VUT at the end."""
        return float(self.trajectory.x_vut_m[-1])

'''
    },
    "samplers/registry.py": {
        '        "uniform": "merge': '        "corner": "merge_sumo.samplers.corner:Corner",\n'
    },
    "controllers/kinds.py": {
        '        HERE: "merge': '        "hold": "merge_sumo.controllers.hold:HoldKind",\n'
    },
    "reports/templates/report.html.jinja": {
        "<noscript>": '{% include "sections/thanks.html.jinja" %}\n'
    },
    "config.py": {
        "    sense: AnySensing": '''    late_m: float | None = None
    """Distance after M at which episodes end."""
'''
    },
    "scenario/scenario.py": {
        "    mainline: Edges": "    late_m: float = 0.0\n",
        "        arrived: NDArray": "        end_m += self.late_m\n",
    },
}
"""Text that recipes insert into a file, before a place that it has once."""


@pytest.fixture(scope="module")
def copied(tmp_path_factory) -> Path:
    """Return a copy of the package in which every recipe was followed."""
    folder = tmp_path_factory.mktemp("copy")
    package = folder / "merge_sumo"
    shutil.copytree(ROOT / "merge_sumo", package)
    for name in ("policies", "sumo_net"):
        (folder / name).symlink_to(ROOT / name)
    for name, text in NEW.items():
        (package / name).write_text(text, encoding="utf-8")
    for name, edits in MORE.items():
        source = (package / name).read_text(encoding="utf-8")
        for place, text in edits.items():
            assert source.count(place) == 1, (name, place)
            source = source.replace(place, text + place)
        (package / name).write_text(source, encoding="utf-8")
    return folder


def run_in(folder: Path, *words: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "merge_sumo.cli", *words],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(folder)},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_the_pages_name_the_files_of_their_recipes():
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in PAGES)
    for file in MORE:
        assert f"`{file}`" in text
    for file in NEW:
        assert f"{Path(file).parent}/" in text


@pytest.mark.slow
def test_a_campaign_has_what_the_recipes_add(copied):
    words = ("--level", "0", "--cases", "8", "--sampler", "corner", "--workers", "1", "--quiet")
    vut = "cruise?v_mps=20&gain_per_s=2"
    run_in(copied, "campaign", "--vut", vut, *words, "--late-m", "50", "--out", "run")
    records = [json.loads(line) for line in (copied / "run/outcomes.jsonl").open(encoding="utf-8")]
    assert len(records) == 8
    for record in records:
        assert 50.0 <= record["last_m"] < 53.0, "by the option"
    settings = json.loads((copied / "run/campaign.json").read_text(encoding="utf-8"))
    assert (settings["sampler"], settings["scenario"]["late_m"]) == ("corner", 50.0)
    page = (copied / "run/report.html").read_text(encoding="utf-8")
    assert "drove 8 cases." in page


@pytest.mark.slow
def test_a_kind_of_controller_drives_by_its_parameters(copied):
    start = ("--level", "0", "--x", "-250", "--v", "30")
    ended = []
    for until_s in (1, 3):
        vut = f"hold:start?a_mps2=0.5&until_s={until_s}"
        ended.append(json.loads(run_in(copied, "run", "--vut", vut, *start, "--json"))["t_end_s"])
    assert ended[1] < ended[0], "it is earlier where it accelerates for longer"
    assert "hold:START" in run_in(copied, "vuts")
