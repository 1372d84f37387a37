"""Figures that pages state of the shipped drivers, recomputed where that takes seconds.

Pages give the command that prints a figure that takes longer.
"""

# mypy: no-strict-optional

from __future__ import annotations

import json
import re
from functools import cache

import pytest
from docs_pages import ROOT

import merge_sumo as ms
from merge_sumo.analysis.truth import REAL_REGION
from merge_sumo.drivers.levelk import ACTIONS, DECISION_STEPS, FEATURES
from merge_sumo.drivers.policies import load_network
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.training.reward import RewardWeights

LIBRARIES = ("", "human/", "roundabout/")
DEFAULT, HUMAN, ROUNDABOUT = (f"policies/{library}README.md" for library in LIBRARIES)


def page(name):
    """Return the text of a page."""
    return (ROOT / name).read_text(encoding="utf-8")


@cache
def figures(vut, level, cases, **settings):
    """Return failures, FMC as pages write it, and the sizes of the regions of a truth."""
    (truth,) = ms.truth(vut, level=level, cases=cases, **settings).truths.values()
    record = truth.to_record()
    failures = record["failures"]
    sizes = [size for size in record["region_sizes"] if size >= REAL_REGION * failures]
    return failures, f"{record['fmc']:.4f}".lstrip("0") if failures else "0", sizes


@pytest.mark.slow
class TestTruths:
    def test_of_the_designs(self):
        rows = {
            "design 1, level 0": ("design1", 0, 10_000, "1 |"),
            "design 2, level 0": ("design2", 0, 10_000, "0 |"),
            "design 2, level 1": ("design2", 1, 10_000, "3 (53, 23 and 4 failures) |"),
            "design 2, level 2": ("design2", 2, 20_000, "10, most of one or two failures"),
        }
        for name, (vut, level, cases, regions) in rows.items():
            failures, fmc, sizes = figures(vut, level, cases)
            row = f"| {name}, {cases:,} cases | {failures} | {fmc} | {regions}"
            assert row in page(DEFAULT)
            assert len(sizes) == int(regions.split()[0].strip(","))
        assert figures("design2", 1, 10_000)[2] == [53, 23, 4]

    def test_of_the_paper(self):
        of = (("design1", 0, 10_000), ("design2", 1, 10_000), ("design2", 2, 20_000))
        first, second, third = (figures(*one)[1] for one in of)
        row = f" | {first} (.1296) | {second} (.0849) | {third} (.0073) |"
        assert row in page("README.md")
        assert row in page("docs/explanation/paper.md")

    @pytest.mark.parametrize("vut", ["design1", "design2"])
    @pytest.mark.parametrize(("level", "cases"), [(0, 10_000), (1, 10_000), (2, 20_000)])
    def test_of_the_drivers_of_people(self, vut, level, cases):
        (row,) = re.findall(rf"^\| {vut}, level {level} \| (.*)$", page(HUMAN), re.MULTILINE)
        stated = [cell.strip() for cell in row.split("|")]
        for at, settings in ((0, {}), (3, {"policies": "human"})):
            failures, fmc, sizes = figures(vut, level, cases, **settings)
            assert stated[at : at + 2] == [str(failures), fmc]
            assert stated[at + 2] in ("", str(len(sizes)))

    @pytest.mark.parametrize(("level", "cases"), [(0, 10_000), (1, 10_000), (2, 20_000)])
    def test_of_the_roundabout(self, level, cases):
        failures, fmc, sizes = figures("roundabout", level, cases, scenario="roundabout")
        row = f"| level {level} | {cases:,} | {failures} | {fmc} | {len(sizes)} |"
        assert row in page(ROUNDABOUT)
        share = ("none of 10,000 uniform", f"{failures}, all", f"{failures} of 20,000")[level]
        assert f"at level {level} in {share}" in page("docs/how-to/scenarios.md")


@pytest.mark.parametrize("library", LIBRARIES, ids=["default", "human", "roundabout"])
def test_the_regret_of_networks_is_that_of_their_manifest(library):
    text, folder = page(f"policies/{library}README.md"), ROOT / "policies" / library
    networks = json.loads((folder / "manifest.json").read_text())["networks"]
    for name, network in networks.items():
        check = network["check"]
        shown = [f"{check[key]:.3f}" for key in ("mean_return", "mean_best", "mean_level0")]
        row = (
            f"| `{name}` | {check['mean_regret']:.2%} | {check['p99_regret']:.1%} | "
            f"{check['avoidable_collisions']} | {' | '.join(shown)} |"
        )
        assert row in text
        if library != "roundabout/":
            assert f"{row} {network['training_s']:.0f} s |" in text


def test_weights_and_networks_are_those_of_the_code():
    weights = RewardWeights.of(US23)
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \| (?:per|once)", page(DEFAULT), re.MULTILINE)
    assert len(rows) == 9
    for name, value in rows:
        assert getattr(weights, name) == float(value)
    layers = load_network("pov1").layers
    widths = [len(bias) for _, bias in layers]
    assert widths == [128, 128, ACTIONS]
    assert "two hidden layers of 128 rectified units" in page(DEFAULT)
    assert f"{FEATURES} functions of the state" in page(DEFAULT)
    assert f"decides every {DECISION_STEPS * DT_S:g} s" in page(DEFAULT)
