"""Figures that pages state of the shipped drivers, recomputed where that takes seconds.

Beside a figure that takes longer stands the command that prints it.
"""

# mypy: no-strict-optional

from __future__ import annotations

import json
import re
from functools import cache

import make_scenarios
import numpy as np
import pytest
from docs_pages import ROOT

import merge_sumo as ms
from merge_sumo.analysis.truth import REAL_REGION
from merge_sumo.drivers.levelk import ACTIONS, DECISION_STEPS, FEATURES
from merge_sumo.drivers.policies import load_network
from merge_sumo.metrics.score import measure
from merge_sumo.scenario.scenario import DT_S, US23
from merge_sumo.training.reward import RewardWeights

LIBRARIES = ("", "human/", "roundabout/")
DEFAULT, HUMAN, ROUNDABOUT = (f"policies/{library}README.md" for library in LIBRARIES)


def page(name):
    """Return the text of a page."""
    return (ROOT / name).read_text(encoding="utf-8")


@cache
def truth(vut, level, cases, **settings):
    """Return the truth of a VUT at a level."""
    return ms.truth(vut, level=level, cases=cases, **settings).truths[level]


def figures(vut, level, cases, **settings):
    """Return failures, FMC as pages write it, and the sizes of the regions of a truth."""
    record = truth(vut, level, cases, **settings).to_record()
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
        assert row in page("docs/explanations/paper.md")

    def test_of_other_samples(self):
        for seed, told in ((1, [57, 22, 7]), (2, [51, 15, 5])):
            failures, _, sizes = figures("design2", 1, 10_000, seed=seed)
            assert sizes == told
            assert f"{failures}" in page(DEFAULT).partition("With `--seed 1`")[2][:70]
        assert "regions of 57, 22 and 7, and of 51, 15 and 5." in page(DEFAULT)
        failures, fmc, sizes = figures("design2", 1, 100_000)
        assert f"100000`: {failures} failures, FMC {fmc}, two regions;" in page(DEFAULT)
        assert len(sizes) == 2

    @pytest.mark.parametrize("vut", ["design1", "design2"])
    @pytest.mark.parametrize(("level", "cases"), [(0, 10_000), (1, 10_000), (2, 20_000)])
    def test_of_the_drivers_of_people(self, vut, level, cases):
        (row,) = re.findall(rf"^\| {vut}, level {level} \| (.*)$", page(HUMAN), re.MULTILINE)
        told = [cell.strip() for cell in row.split("|")]
        for at, settings in ((0, {}), (3, {"policies": "human"})):
            failures, fmc, sizes = figures(vut, level, cases, **settings)
            assert told[at : at + 2] == [str(failures), fmc]
            assert told[at + 2] in ("", str(len(sizes)))

    @pytest.mark.parametrize(("level", "cases"), [(0, 10_000), (1, 10_000), (2, 20_000)])
    def test_of_the_roundabout(self, level, cases):
        failures, fmc, sizes = figures("roundabout", level, cases, scenario="roundabout")
        row = f"| level {level} | {cases:,} | {failures} | {fmc} | {len(sizes)} |"
        assert row in page(ROUNDABOUT)
        said = ("none of 10,000 uniform", f"{failures}, all", f"{failures} of 20,000")[level]
        assert f"at level {level} in {said}" in page("docs/explanations/scenarios.md")

    def test_of_a_queue(self):
        sizes, queue = ((0, 20_000), (1, 10_000)), {"scenario": "us23-traffic"}
        never, alone = (figures("design2", *of)[0] for of in sizes)
        seldom, with_it = (figures("design2", *of, **queue)[0] for of in sizes)
        assert never == 0
        assert (
            f"at level 0 in none of 20,000 uniform cases alone and in {seldom} with the queue; "
            f"at level 1 in {alone} of 10,000 alone and in {with_it} with it"
        ) in page("docs/explanations/scenarios.md")


def test_the_failure_of_design_2_at_level_0_is_one():
    command = r"--vut design2 --level 0 --x=(\S+) --v=(\S+)` .* dx = (\S+) m"
    x_m, v_mps, dx_m = map(float, re.search(command, page(DEFAULT)).groups())
    ran = ms.run("design2", level=0, x_pov0_m=x_m, v_pov0_mps=v_mps)
    assert ran.failed
    assert ran.measures.dx_m == pytest.approx(dx_m, abs=0.05)


class TestTheExampleRuns:
    TEXT = page(DEFAULT).partition("The example runs")[2]
    SCENARIOS = page("scenarios/README.md")

    @pytest.fixture(scope="class")
    @classmethod
    def runs(cls):
        return {name: make_scenarios.play(e) for name, e in make_scenarios.EXAMPLES.items()}

    def test_of_the_first_and_the_second(self, runs):
        first, second = runs["pov-yields"], runs["vut-waits"]
        ahead_m = first.x_vut_m[-1] - first.x_pov_m[-1]
        assert f"the level-0 VUT merges {ahead_m:.0f} m ahead of it" in self.TEXT
        waits_s = DT_S * np.flatnonzero(second.a_vut_mps2 > 0.0)[0]
        gap_m, fastest_mps = second.x_pov_m[-1] - second.x_vut_m[-1], second.v_pov_mps.max()
        assert (
            f"waits for {waits_s:.1f} s, the POV accelerates to {fastest_mps:.1f} m/s and is "
            f"{gap_m:.0f} m ahead"
        ) in self.TEXT

    def test_of_the_third(self, runs):
        run = runs["stalemate"]
        (braking,) = np.nonzero(run.a_vut_mps2 < -0.01)
        (slowing,) = np.nonzero(run.a_pov_mps2 < -0.01)
        begins_s, hardest_mps2 = DT_S * braking[0], -run.a_vut_mps2.min()
        from_s, until_s = DT_S * slowing[0], DT_S * (slowing[-1] + 1)
        dx_m = run.x_pov_m[-1] - run.x_vut_m[-1]
        assert (
            f"brakes from {begins_s:.1f} s on, by {hardest_mps2:.1f} m/s2 at last, the POV brakes "
            f"before that, from {from_s:.1f} to {until_s:.1f} s, and they collide with dx = "
            f"{dx_m:.1f} m"
        ) in self.TEXT
        closed_s = measure(run).last_avoidable_s
        assert (
            f"begins at {begins_s:.1f} s, after its last way out has closed at {closed_s:.1f} s"
        ) in self.SCENARIOS

    def test_of_the_roundabout(self, runs):
        run = runs["roundabout-yields"]
        fast, slow = run.v_pov_mps.max(), run.v_pov_mps.min()
        ahead_m = run.x_vut_m[-1] - run.x_pov_m[-1]
        assert (
            f"slows down from {fast:.1f} to {slow:.1f} m/s and the VUT merges {ahead_m:.0f} m ahead"
        ) in self.SCENARIOS


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
