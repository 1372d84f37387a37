"""Disks that are full, folders that are read-only or gone."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from attacks import World
from campaigning import campaign_settings, run_campaign
from plans import plan_for
from writers import CAMPAIGN

from merge_sumo.campaigns.run import Run
from merge_sumo.errors import UserError
from merge_sumo.road.merge import default_net_path
from merge_sumo.studies.truth import ground_truth

SMALL = (*CAMPAIGN.split(), "--out", "new")


def world_with(run, root: Path, **changes) -> World:
    world = World(root, **changes)
    shutil.copytree(run.folder, root / "run")
    shutil.copy(default_net_path(), root)
    world.cache.mkdir()
    return world


class Vanishing:
    """Told of cases; has a folder vanish at one of them."""

    def __init__(self, folder: Path, at: int = 5) -> None:
        self.folder, self.left = folder, at

    def __call__(self, *_: object) -> None:
        self.left -= 1
        if self.left == 0:
            shutil.rmtree(self.folder)


class TestAFolderThatVanishes:
    SETTINGS = campaign_settings(vut="design1", sampler="uniform", cases=40, batch=20, seed=1)

    @pytest.mark.parametrize("gone", ["above/run", "above"])
    def test_under_or_above_a_campaign_ends_it_in_a_sentence(self, tmp_path, gone):
        (tmp_path / "above").mkdir()
        with pytest.raises(UserError, match=r"cannot write .*No such file or directory"):
            run_campaign(
                self.SETTINGS, tmp_path / "above" / "run", on_case=Vanishing(tmp_path / gone)
            )

    def test_with_trajectories_ends_it_and_keeps_the_outcomes(self, tmp_path):
        # Not uniform: its batches run ahead, and those that end together are written together.
        settings = replace(self.SETTINGS, sampler="annealing")
        gone = Vanishing(tmp_path / "run" / "trajectories", at=15)
        with pytest.raises(UserError, match=r"cannot write .*No such file or directory"):
            run_campaign(settings, tmp_path / "run", on_case=gone)
        assert len(Run(tmp_path / "run").outcomes) == 20

    def test_with_the_cache_is_made_again(self, tmp_path):
        (tmp_path / "cache").mkdir()
        gone = Vanishing(tmp_path / "cache", at=1)
        truth = ground_truth(plan_for("design1"), 0, 200, cache=tmp_path / "cache", on_cases=gone)
        again = ground_truth(plan_for("design1"), 0, 200, cache=tmp_path / "cache")
        assert again.margin.tobytes() == truth.margin.tobytes()
        assert len(list((tmp_path / "cache").iterdir())) == 1

    def test_where_one_works_is_named(self, run, tmp_path):
        world = world_with(run, tmp_path / "world")
        world.cache.rename(tmp_path / "cache")
        world.environment["MERGE_SUMO_CACHE"] = str(tmp_path / "cache")
        script = (
            "import os, sys; os.mkdir('here'); os.chdir('here'); os.rmdir('../here');"
            "from merge_sumo.cli import main; sys.argv[0] = 'merge-sumo'; main()"
        )
        for arguments in (SMALL, ("export", "run", "0"), ("report", "run")):
            code, _, err = world.run(*arguments, script=script)
            assert code == 2, err
            assert "Traceback" not in err, err
