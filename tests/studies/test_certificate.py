"""Certificates: the lattice covers, planted balls are found, a stop changes nothing, and who
checks one trusts nothing.
"""

from __future__ import annotations

import hashlib
import io
import itertools
import json
import math

import check_certificate
import numpy as np
import pytest
from calling import assert_refused
from campaigning import campaign_settings
from scipy.spatial import cKDTree

from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.studies import certificate
from merge_sumo.studies.certificate import (
    CERTIFICATE,
    CheckedCase,
    CoveringLattice,
    covering,
    lattices_of,
)
from merge_sumo.system.signature import signed, user_key, verified

LOW, HIGH = np.array([-340.0, 25.0, 0.0]), np.array([-180.0, 35.0, math.pi / 2])
"""The pool of the paper, written down again: nothing here asks the lattice or the pool."""


def settings(*levels, vut="design2"):
    return campaign_settings(vut=vut, levels=levels)


def certify(settings, radius, folder, run, **other):
    return certificate.certify(settings, radius, folder, resolve(settings), run, **other)


def planted(centres=(), radius=0.1, untold=lambda unit: False):
    """Return what runs points, of a VUT that fails in balls of the unit cube and nowhere else."""
    balls = cKDTree(centres) if len(centres) else None

    def run(level, points):
        cases = settings(level).pool.cases(np.asarray(points), level)
        for place, case in reversed(list(enumerate(cases))):
            values = case.x_pov0_m, case.v_pov0_mps, case.svo_rad
            values = tuple(v for v in values if v is not None)
            dims = len(values)
            unit = (np.array(values) - LOW[:dims]) / (HIGH - LOW)[:dims]
            failed = balls is not None and balls.query(unit)[0] <= radius
            yield (
                place,
                CheckedCase(values, -600.0 if failed else -1.0, failed, not untold(unit), {}),
            )

    return run


def failing(folder, level):
    """Return the failing cases of a folder in the unit cube."""
    parts = []
    for path in sorted((folder / f"level-{level}").iterdir()):
        with np.load(path) as block:
            parts.append(block["case"][block["failed"]])
    cases = np.concatenate(parts)
    return (cases - LOW[: cases.shape[1]]) / (HIGH - LOW)[: cases.shape[1]]


def places(dims, count, seed):
    """Return places of the cube: anywhere, on faces, on edges and in all corners."""
    rng = np.random.default_rng(seed)
    found = rng.random((count, dims))
    on_faces = rng.integers(0, dims + 1, count)
    for row, axes in enumerate(on_faces.tolist()):
        chosen = rng.permutation(dims)[:axes]
        found[row, chosen] = rng.integers(0, 2, axes)
    corners = np.array(list(itertools.product((0.0, 1.0), repeat=dims)))
    return np.concatenate([corners, found])[:count]


class TestTheLattice:
    def test_has_the_points_whose_indices_are_all_even_or_all_odd(self):
        wanted = [(0, 0), (0, 1), (0.5, 0), (0.5, 1), (1, 0), (1, 1), (0.25, 0.5), (0.75, 0.5)]
        assert [tuple(p) for p in CoveringLattice((4, 2)).points(0, 99).tolist()] == wanted

    def test_is_body_centred_in_three_dimensions(self):
        found = CoveringLattice((2, 2, 2))
        corners = list(itertools.product((0.0, 1.0), repeat=3))
        assert [tuple(p) for p in found.points(0, 99).tolist()] == [*corners, (0.5, 0.5, 0.5)]
        # A cube of edge 1: the farthest places are (1/2, 1/4, 0) and its images.
        assert found.radius == pytest.approx(math.hypot(0.5, 0.25))

    @pytest.mark.parametrize("steps", [(7, 4), (5, 5, 5)])
    def test_is_the_same_in_pieces(self, steps):
        found = CoveringLattice(steps)
        whole = found.points(0, len(found))
        pieces = [found.points(first, first + 3) for first in range(0, len(found), 3)]
        assert np.array_equal(np.concatenate(pieces), whole)
        assert len(np.unique(whole, axis=0)) == len(found)

    @pytest.mark.parametrize("dims", [2, 3])
    @pytest.mark.parametrize("radius", [0.5, 0.31, 0.07])
    def test_has_a_point_within_the_radius_of_every_place(self, dims, radius):
        found = covering(radius, dims)
        points = found.points(0, len(found))
        assert ((points >= 0.0) & (points <= 1.0)).all()
        apart = cKDTree(points).query(places(dims, 5_000, 1))[0].max()
        assert apart <= found.radius < radius
        assert check_certificate.farthest(points, radius) == pytest.approx(found.radius)

    @pytest.mark.parametrize(("dims", "thickness"), [(2, 1.2092), (3, 1.4635)])
    def test_needs_hardly_more_points_than_the_best_lattice_of_space(self, dims, thickness):
        # Kershner's and Bambah's: the volume of all balls, as a multiple of that of the space.
        ball = math.pi * 0.01**2 if dims == 2 else 4.0 / 3.0 * math.pi * 0.01**3
        assert thickness <= len(covering(0.01, dims)) * ball <= 1.04 * thickness

    @pytest.mark.parametrize(
        ("radius", "dims", "said"),
        [
            (0.0, 2, "above 0 and up to 0.5"),
            (0.51, 3, "above 0 and up to 0.5"),
            (math.nan, 2, "above 0 and up to 0.5"),
            (0.001, 3, "cases and more at a level"),
            (1e-9, 2, "cases and more at a level"),
            (0.1, 4, "the pool has 4 coordinates"),
        ],
    )
    def test_refuses_what_cannot_be(self, radius, dims, said):
        with pytest.raises(UserError, match=said):
            covering(radius, dims)

    def test_refuses_a_pool_of_four_coordinates(self):
        traffic = CampaignSettings(
            vut="design2", levels=(0,), scenario=named_scenario("us23-traffic")
        )
        with pytest.raises(UserError, match="the pool has 4 coordinates"):
            lattices_of(traffic, 0.1)


class TestPlantedBalls:
    def found(self, folder, level, dims, radius, seed):
        """Return how many of 1,000 balls, slightly larger than certified, hold a failure."""
        centres = places(dims, 1000, seed)
        done = certify(settings(level), radius, folder, planted(centres, 1.01 * radius))
        assert not done.certain
        apart = cKDTree(failing(folder, level)).query(centres)[0]
        return int((apart <= 1.01 * radius).sum())

    @pytest.mark.parametrize(("level", "dims", "radius"), [(1, 2, 0.02), (2, 3, 0.1)])
    def test_are_found_all_of_them(self, tmp_path, level, dims, radius):
        assert self.found(tmp_path / "c", level, dims, radius, seed=2) == 1000

    @pytest.mark.long
    @pytest.mark.parametrize("seed", [3, 4, 5])
    @pytest.mark.parametrize(("level", "dims"), [(0, 2), (2, 3)])
    def test_of_one_percent_are_found_all_of_them(self, tmp_path, level, dims, seed):
        assert self.found(tmp_path / "c", level, dims, 0.01, seed) == 1000

    def test_that_are_smaller_may_lie_between_the_cases(self, tmp_path):
        lattice = covering(0.1, 2)
        p, h = 1.0 / max(lattice.steps), 1.0 / min(lattice.steps)
        hole = np.array([[p * round(0.5 / p / 2) * 2, 2 * h + lattice.radius]])
        ball = planted(hole, 0.99 * lattice.radius)
        assert certify(settings(0), 0.1, tmp_path / "c", ball).certain
        assert not certify(
            settings(0), 0.1, tmp_path / "d", planted(hole, 1.01 * lattice.radius)
        ).certain


class TestACertificate:
    def test_says_what_is_certain_and_in_what_units(self, tmp_path):
        done = certify(settings(0, 2), 0.1, tmp_path / "c", planted())
        assert done.certain
        assert done.sentence == (
            "design2 v level 0/2, 611 cases: no ball of radius 10 % of the axes (16 m, 1 m/s, "
            "0.16 rad) fails throughout: certain, the simulation is deterministic"
        )
        assert check_certificate.check(tmp_path / "c")[1] == []

    def test_names_the_failures(self, tmp_path):
        done = certify(settings(0), 0.1, tmp_path / "c", planted(np.zeros((1, 2)), 0.01))
        assert "52 cases: 1 fail: every ball of radius 10 %" in done.sentence
        assert done.levels[0].worst == [{"x_pov0_m": -340.0, "v_pov0_mps": 25.0, "score": -600.0}]
        assert check_certificate.check(tmp_path / "c")[1] == []

    def test_is_none_where_a_case_gave_no_verdict(self, tmp_path):
        silent = planted(untold=lambda unit: unit[0] == 0.0)
        done = certify(settings(0), 0.1, tmp_path / "c", silent)
        assert not done.certain
        assert "none fails; 4 gave no verdict" in done.sentence
        assert check_certificate.check(tmp_path / "c")[1] == []

    @pytest.mark.parametrize("fails", [0, 1])
    def test_is_none_of_a_vut_that_does_not_do_again_what_it_did(self, tmp_path, fails):
        runs, steady = [], planted(np.zeros((fails, 2)), 0.01)

        def moody(level, points):
            runs.append(len(points))
            for place, done in steady(level, points):
                drifts = len(runs) > 1 and place < 3
                yield place, done._replace(score=done.score + 1e-12 * drifts)

        done = certify(settings(0), 0.1, tmp_path / "c", moody)
        assert runs == [52, 13]
        assert not done.certain
        assert done.sentence == (
            f"design2 v level 0, 52 cases: {fails or 'none'} fail, and nothing is certain: 3 of 13 "
            "that were run twice did not end as before"
        )
        assert check_certificate.check(tmp_path / "c")[1] == []
        # Whoever goes on with it asks again.
        again = certify(settings(0), 0.1, tmp_path / "c", steady, resume=True)
        assert again.levels[0].otherwise == 0

    def test_is_the_same_to_the_last_byte_however_often_it_was_stopped(self, tmp_path, monkeypatch):
        monkeypatch.setattr(certificate, "BLOCK", 70)
        run = planted(untold=lambda unit: unit[0] < 0.3)
        certify(settings(1, 2), 0.1, tmp_path / "whole", run)
        left: list[int] = [3]
        told: list = []

        def stop():
            left[0] -= 1
            if not left[0]:
                raise KeyboardInterrupt

        for again in range(20):
            left[0] = 3
            told.clear()
            try:
                certify(
                    *(settings(1, 2), 0.1, tmp_path / "stopped", run),
                    resume=again > 0,
                    check=stop,
                    on_cases=told.append,
                )
                break
            except KeyboardInterrupt:
                found = json.loads((tmp_path / "stopped" / CERTIFICATE).read_text())["found"]
                assert found is None
        assert 3 <= again <= 5
        assert sum(told) == 52 + 559
        files = [p.relative_to(tmp_path / "whole") for p in (tmp_path / "whole").rglob("*.*")]
        assert len(files) == 1 + 1 + 8
        for file in files:
            one, other = tmp_path / "whole" / file, tmp_path / "stopped" / file
            assert one.read_bytes() == other.read_bytes()

    def test_runs_a_spoilt_block_again(self, tmp_path):
        folder = tmp_path / "c"
        certify(settings(0), 0.1, folder, planted())
        block = folder / "level-0" / "00000.npz"
        before = block.read_bytes()
        block.write_bytes(before[:-50])
        certify(settings(0), 0.1, folder, planted(), resume=True)
        assert block.read_bytes() == before

    def test_goes_on_with_its_own_settings_only(self, tmp_path):
        folder = tmp_path / "c"
        certify(settings(0), 0.1, folder, planted())
        for other, radius, said in (
            (settings(0), 0.2, "radius differs: .* was begun with 0.1, now it is 0.2"),
            (settings(0, vut="design1"), 0.1, "settings.vut differs"),
        ):
            with pytest.raises(UserError, match=said):
                certify(other, radius, folder, planted(), resume=True)
        with pytest.raises(UserError, match="exists"):
            certify(settings(0), 0.1, folder, planted())
        with pytest.raises(UserError, match="no certificate to go on with"):
            certify(settings(0), 0.1, tmp_path, planted(), resume=True)


class TestBlocksThatSomebodyPlanted:
    """When a certificate goes on, only blocks that this user has run count."""

    @pytest.fixture
    def begun(self, tmp_path):
        certify(settings(0), 0.1, tmp_path / "c", planted(np.zeros((1, 2)), 0.2))
        return tmp_path / "c"

    def go_on(self, folder) -> int:
        """Go on with a certificate; return how many cases ran that are not run twice anyway."""
        counted: list[int] = []
        run = planted(np.zeros((1, 2)), 0.2)
        certify(settings(0), 0.1, folder, run, resume=True, on_cases=counted.append)
        return sum(counted[1:])

    def test_those_of_this_user_do_not_run_again(self, begun):
        before = (begun / CERTIFICATE).read_bytes()
        assert self.go_on(begun) == 0
        assert (begun / CERTIFICATE).read_bytes() == before

    @pytest.mark.parametrize("how", ["unsigned", "of another user", "of another level"])
    def test_others_run_again(self, begun, how):
        path = begun / "level-0" / "00000.npz"
        honest = path.read_bytes()
        with np.load(path) as data:
            block = dict(data)
        assert block["failed"].any()
        block["failed"][:] = False
        block["score"][:] = -1.0
        content = io.BytesIO()
        np.savez(content, **block)
        forged = content.getvalue()
        if how == "of another user":
            record = json.loads((begun / CERTIFICATE).read_text())
            asked = {k: v for k, v in record.items() if k not in ("files", "found", "sha256")}
            of = hashlib.sha256(json.dumps(asked, sort_keys=True).encode()).hexdigest()
            what = f"block 0 of level 0 of the certificate {of}"
            assert verified(honest, what, user_key()) is not None
            forged = signed(forged, what, b"k" * 32)
        elif how == "of another level":
            forged = signed(forged, "block 0 of level 1 of another certificate", user_key())
        path.write_bytes(forged)
        assert self.go_on(begun) == 52
        assert path.read_bytes() == honest
        assert certified_failures(begun) > 0


def certified_failures(folder) -> int:
    return json.loads((folder / CERTIFICATE).read_text())["found"]["levels"]["0"]["failures"]


class TestWhoChecksOne:
    """The checker shares nothing with what it checks."""

    @pytest.fixture
    def folder(self, tmp_path):
        certify(settings(0), 0.1, tmp_path / "c", planted(np.zeros((1, 2)), 0.01))
        return tmp_path / "c"

    def rewrite(self, folder, change):
        """Change the cases of a level, and the hashes with them, as a forger would."""
        path = folder / "level-0" / "00000.npz"
        with np.load(path) as data:
            block = change(dict(data))
        np.savez(path, **block)
        self.restate(folder, cases=len(block["case"]), block=block)

    def restate(self, folder, *, cases, block, **found):
        path = folder / CERTIFICATE
        record = json.loads(path.read_text())
        del record["sha256"]
        digest = hashlib.sha256()
        for name in check_certificate.ARRAYS:
            digest.update(block[name].tobytes())
        record["levels"]["0"]["cases"] = cases
        record["found"]["levels"]["0"] |= {"sha256": digest.hexdigest()}
        record["found"] |= found
        text = json.dumps(record, sort_keys=True).encode()
        record["sha256"] = hashlib.sha256(text).hexdigest()
        path.write_text(json.dumps(record))

    def test_finds_a_changed_record(self, folder):
        path = folder / CERTIFICATE
        path.write_text(path.read_text().replace("design2", "design1"))
        assert check_certificate.check(folder)[1] == ["certificate.json was changed"]

    def test_finds_a_changed_verdict(self, folder):
        path = folder / "level-0" / "00000.npz"
        with np.load(path) as data:
            block = dict(data)
        block["failed"][:] = False
        np.savez(path, **block)
        wrong = check_certificate.check(folder)[1]
        assert "level 0: cases or verdicts were changed" in wrong
        assert any("1 contradict themselves" in sentence for sentence in wrong)

    @pytest.mark.parametrize("gone", [0, 20, 51])
    def test_finds_that_a_case_is_missing(self, folder, gone):
        self.rewrite(folder, lambda block: {k: np.delete(v, gone, 0) for k, v in block.items()})
        wrong = check_certificate.check(folder)[1]
        assert "level 0: a place of the pool is farther than 0.1 from every case" in wrong

    def test_finds_that_nothing_is_certain(self, folder):
        with np.load(folder / "level-0" / "00000.npz") as data:
            block = dict(data)
        self.restate(folder, cases=52, block=block, certain=True)
        assert check_certificate.check(folder)[1] == [
            "it says that it is certain, and is not, or the other way round"
        ]

    @pytest.mark.parametrize(
        ("points", "apart"),
        [
            ([[0.5, 0.5]], math.sqrt(0.5)),
            ([[0.0, 0.0]], math.sqrt(2.0)),
            ([[0, 0], [0, 1], [1, 0], [1, 1]], math.sqrt(0.5)),
            ([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], math.sqrt(1.25)),
            # Of the two points at the bottom the corner above is 1.25 away, at (0, 1) and (1, 1).
            ([[0.25, 0.0], [0.75, 0.0]], math.hypot(0.25, 1.0)),
        ],
    )
    def test_knows_the_farthest_place(self, points, apart):
        assert check_certificate.farthest(np.array(points, dtype=float), 1.5) == pytest.approx(
            apart
        )

    def test_agrees_with_many_places_about_points_that_are_no_lattice(self):
        rng = np.random.default_rng(7)
        for dims in (2, 3):
            points = rng.random((60, dims))
            apart = cKDTree(points).query(rng.random((50_000, dims)))[0].max()
            radius = check_certificate.farthest(points, 0.5)
            assert apart <= radius <= 1.1 * apart
            # Just below it, it says no.
            assert check_certificate.farthest(points, 0.999 * radius) > 0.999 * radius

    def test_looks_slab_by_slab_with_the_same_result(self, monkeypatch):
        found = covering(0.1, 3)
        points = found.points(0, len(found))
        monkeypatch.setattr(check_certificate, "SLAB", 280)
        assert check_certificate.farthest(points, 0.1) == pytest.approx(found.radius)
        # Without the point in the middle, which stands on the edge of a slab, somewhere is bare.
        middle = int(np.abs(points - 0.5).sum(axis=1).argmin())
        assert check_certificate.farthest(np.delete(points, middle, 0), 0.1) > 0.1


class TestTheCommand:
    def test_certifies_in_sumo_and_is_checked(self, command_line, tmp_path):
        plan = ("certify", "--vut", "design2", "--level", 0, "--radius", 0.1, "--workers", 1)
        code, out, err = command_line(*plan, "--out", tmp_path / "c", "--json")
        assert code == 0, err
        found = json.loads(out)
        assert found["certain"]
        assert found["levels"]["0"]["cases"] == 52
        assert check_certificate.check(tmp_path / "c")[1] == []
        again, out, _ = command_line(*plan, "--resume", tmp_path / "c")
        assert again == 0
        assert "no ball of radius 10 % of the axes (16 m, 1 m/s) fails throughout" in out

    def test_says_that_sumo_ran_a_share_of_the_cases_and_stays_with_its_engine(
        self, command_line, tmp_path
    ):
        plan = ("certify", "--vut", "design2", "--level", 0, "--radius", 0.1, "--workers", 1)
        kinematic = (*plan, "--engine", "kinematic")
        code, out, err = command_line(*kinematic, "--out", tmp_path / "c", "--json")
        assert code == 0, err
        sentence = json.loads(out)["sentence"]
        assert "52 cases by the equations of motion, at least 1% of them in SUMO, too" in sentence
        assert json.loads((tmp_path / "c" / "certificate.json").read_bytes())["engine"] == (
            "kinematic"
        )
        assert check_certificate.check(tmp_path / "c")[1] == []
        code, _, err = command_line(*plan, "--resume", tmp_path / "c")
        assert code == 2
        assert "engine differs" in err

    def test_names_what_fails_and_ends_with_1(self, command_line, tmp_path):
        plan = ("certify", "--vut", "design1", "--level", 0, "--radius", 0.04, "--workers", 1)
        code, out, err = command_line(*plan, "--out", tmp_path / "c")
        assert code == 1, err
        assert "fail: every ball of radius 4 %" in out
        assert "x_pov0_m" in out

    def test_goes_by_any_criterion(self, command_line, tmp_path):
        plan = ("certify", "--vut", "design2", "--level", 0, "--radius", 0.3, "--workers", 1)
        criterion = ("--fail-when", 'end == "MERGED"')
        code, out, err = command_line(*plan, *criterion, "--out", tmp_path / "c", "--json")
        assert code == 1, err
        assert 'cases that may fail by end == "MERGED": ' in json.loads(out)["sentence"].replace(
            "'", '"'
        )
        found = json.loads(out)["levels"]["0"]
        assert found["failures"] == found["cases"] == len(covering(0.3, 2))
        assert check_certificate.check(tmp_path / "c")[1] == []
        assert_refused(
            command_line(*plan, "--resume", tmp_path / "c"), "settings.fail_when differs"
        )

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            (("--radius", 2), "--radius is 2.0"),
            (("--scenario", "us23-traffic"), "the pool has 4 coordinates"),
            (("--resume", "here", "--out", "there"), "leave --out away"),
            (("--resume", "here"), "here is no certificate to go on with"),
            (("--workers", 0), "--workers is 0"),
        ],
    )
    def test_refuses_what_it_cannot_do(self, command_line, tmp_path, monkeypatch, options, said):
        monkeypatch.chdir(tmp_path)
        assert_refused(command_line("certify", "--vut", "design2", "--level", 0, *options), said)
        assert not list(tmp_path.iterdir())
