"""The recipes of CONTRIBUTING: each is applied to a copy of the package, and what it adds runs."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from dataclasses import dataclass, field
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")


@dataclass(frozen=True)
class Recipe:
    """What is new, by file, and where files get more: text before a place that they have."""

    new: dict[str, str] = field(default_factory=dict)
    more: dict[str, dict[str, str]] = field(default_factory=dict)


RECIPES = {
    "a measure": Recipe(
        more={
            "metrics/measures.py": {
                "    @measure()\n    def end(": '    @measure(unit="m", missing=0.0)\n'
                "    def last_m(self) -> float:\n"
                '        """Position of the VUT at the end."""\n'
                "        return float(self.trajectory.x_vut_m[-1])\n\n",
            }
        }
    ),
    "a sampler": Recipe(
        new={
            "samplers/corner.py": "from merge_sumo.samplers.base import LevelwiseSampler\n\n\n"
            "class CornerSampler(LevelwiseSampler):\n"
            '    about = "draws from a corner of the pool"\n'
            '    colour = "#994F00"\n'
            "    learns = False\n\n"
            "    def propose(self, history, n, rng, level):\n"
            "        return 0.5 * rng.random((n, history.dims))\n"
        },
        more={
            "samplers/registry.py": {
                '        "uniform": "merge': '        "corner": "merge_sumo.samplers.corner:'
                'CornerSampler",\n'
            }
        },
    ),
    "a built-in VUT with two parameters": Recipe(
        new={
            "drivers/cruise.py": "from dataclasses import dataclass\n\nimport numpy as np\n\n"
            "from merge_sumo.drivers.base import BuiltInVut, Design, Driver\n\n\n"
            "@dataclass(frozen=True, kw_only=True, slots=True)\n"
            "class CruiseDesign(Design):\n"
            "    v_mps: float = 28.0\n"
            "    gain_per_s: float = 1.0\n\n\n"
            "class Cruise(Driver):\n"
            "    def __init__(self, corridors, design):\n"
            "        super().__init__(corridors)\n"
            "        self._design = design\n\n"
            "    def begin(self, corridor, case):\n"
            "        pass\n\n"
            "    def act(self, scene):\n"
            "        a_mps2 = self._design.gain_per_s * (self._design.v_mps - scene.v_vut_mps)\n"
            "        return np.clip(a_mps2, -4.0, 1.0)\n\n\n"
            'VUTS = {"cruise": BuiltInVut(Cruise, CruiseDesign())}\n'
        }
    ),
    "a kind of controller with two parameters": Recipe(
        new={
            "controllers/hold.py": "from merge_sumo.controllers.spec import ControllerKind\n"
            "from merge_sumo.controllers.controller import Controller\n\n\n"
            "class HoldKind(ControllerKind):\n"
            '    form, what = "hold:START?a_mps2=A&until_s=T", "accelerates for a while"\n\n'
            "    def __init__(self, spec, options):\n"
            "        super().__init__(spec, options)\n"
            '        self.settable = {"a_mps2": 1.0, "until_s": 2.0} | spec.numbers()\n\n'
            "    def controller(self):\n"
            "        return HoldController(**self.settable)\n\n\n"
            "class HoldController(Controller):\n"
            "    def __init__(self, a_mps2, until_s):\n"
            "        self.a_mps2, self.until_s = a_mps2, until_s\n\n"
            "    def act(self, seen):\n"
            "        return self.a_mps2 if seen.t_s < self.until_s else 0.0\n"
        },
        more={
            "controllers/kinds.py": {
                '        HERE: "merge': '        "hold": "merge_sumo.controllers.hold:HoldKind",\n'
            }
        },
    ),
    "a section of the report": Recipe(
        new={
            "reports/templates/sections/thanks.html.jinja": '<section aria-labelledby="thanks">'
            '<h2 id="thanks">Thanks</h2><p>{{ vut }} drove {{ run.outcomes | length }} cases.</p>'
            "</section>\n"
        },
        more={
            "reports/templates/report.html.jinja": {
                "<noscript>": '{% include "sections/thanks.html.jinja" %}\n'
            }
        },
    ),
    "an option of `campaign` that reaches the engine": Recipe(
        more={
            "config.py": {
                "    sense: AnySensing": "    late_m: float | None = None\n"
                '    """Distance after M at which episodes end."""\n'
            },
            "scenario/scenario.py": {
                "    mainline: Edges": "    late_m: float = 0.0\n",
                "        arrived: NDArray": "        end_m += self.late_m\n",
            },
        }
    ),
}


@pytest.fixture(scope="module")
def copied(tmp_path_factory) -> Path:
    """Return a copy of the package in which every recipe was followed."""
    folder = tmp_path_factory.mktemp("copy")
    shutil.copytree(ROOT / "merge_sumo", folder / "merge_sumo")
    for name in ("policies", "sumo_net"):
        (folder / name).symlink_to(ROOT / name)
    for recipe in RECIPES.values():
        for name, text in recipe.new.items():
            with (folder / "merge_sumo" / name).open("x", encoding="utf-8") as file:
                file.write(text)
        for name, edits in recipe.more.items():
            path = folder / "merge_sumo" / name
            source = path.read_text(encoding="utf-8")
            for place, text in edits.items():
                assert source.count(place) == 1, (name, place)
                source = source.replace(place, text + place)
            path.write_text(source, encoding="utf-8")
    return folder


def ran(folder: Path, *words: str) -> str:
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


@pytest.mark.parametrize(
    ("name", "files"),
    [
        ("a measure", 1),
        ("a sampler", 2),
        ("a built-in VUT with two parameters", 1),
        ("a kind of controller with two parameters", 2),
        ("a section of the report", 2),
        ("an option of `campaign` that reaches the engine", 2),
    ],
)
def test_a_recipe_is_of_so_many_files_which_the_page_names(name, files):
    recipe = RECIPES[name]
    assert len({*recipe.new, *recipe.more}) == files
    for file in recipe.more:
        assert f"`{file}`" in TEXT, file
    for file in recipe.new:
        assert f"{Path(file).parent}/" in TEXT


@pytest.mark.slow
def test_a_campaign_has_what_the_recipes_add(copied):
    words = ("--level", "0", "--cases", "8", "--sampler", "corner", "--workers", "1", "--quiet")
    vut = "cruise?v_mps=20&gain_per_s=2"
    ran(copied, "campaign", "--vut", vut, *words, "--late-m", "50", "--out", "run")
    records = [json.loads(line) for line in (copied / "run/outcomes.jsonl").open(encoding="utf-8")]
    assert len(records) == 8
    assert all(50.0 <= record["last_m"] < 53.0 for record in records), "by the option"
    settings = json.loads((copied / "run/campaign.json").read_text(encoding="utf-8"))
    assert (settings["sampler"], settings["scenario"]["late_m"]) == ("corner", 50.0)
    page = (copied / "run/report.html").read_text(encoding="utf-8")
    assert "drove 8 cases." in page


@pytest.mark.slow
def test_a_kind_of_controller_drives_by_its_parameters(copied):
    start = ("--level", "0", "--x", "-250", "--v", "30")
    ended = []
    for until_s in (1, 3):
        held = f"hold:start?a_mps2=0.5&until_s={until_s}"
        ended.append(json.loads(ran(copied, "run", "--vut", held, *start, "--json"))["t_end_s"])
    assert ended[1] < ended[0], "it is earlier where it accelerates for longer"
    assert "hold:START" in ran(copied, "vuts")
