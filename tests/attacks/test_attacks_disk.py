"""Disks that are full, folders that are read-only or gone."""

from __future__ import annotations

import os
import shlex
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from attacks import World
from campaigning import campaign_settings, run_campaign
from conftest import require
from plans import plan_for
from writers import CAMPAIGN, TRUTH, WRITERS

from merge_sumo.campaigns.run import OUTCOMES, Run
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


def assert_refused(ended: tuple[int, str, str], *parts: str) -> None:
    code, _, err = ended
    assert code == 2, (code, err[-2000:])
    last = err.splitlines()[-1]
    assert last.startswith("merge-sumo: "), err
    assert "Traceback" not in err
    for part in parts:
        assert part in last


def tree(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


COMMANDS = {
    **{name: f"{command} {{disk}}/new{suffix}" for name, (command, suffix) in WRITERS.items()},
    "resume": "campaign --resume {disk}/stopped -q",
    "truth": TRUTH,
    "report": "report {disk}/stopped",
}
"""Every command that writes, and where it does so on the disk."""


@pytest.mark.long
@pytest.mark.parametrize("left", [0, 4096])
@pytest.mark.parametrize("name", COMMANDS)
def test_a_disk_that_is_full_ends_every_writer_in_a_sentence(name, left, run, small_disk, tmp_path):
    world = world_with(run, tmp_path / "world")
    stopped = small_disk / "stopped"
    (stopped / "trajectories").mkdir(parents=True)
    for part in ("campaign.json", OUTCOMES, "trajectories/00000.npz"):
        shutil.copy(run.folder / part, stopped / part)
    lines = (run.folder / OUTCOMES).read_bytes().splitlines(keepends=True)
    (stopped / OUTCOMES).write_bytes(b"".join(lines[:20]))
    if name == "truth":
        shutil.rmtree(world.cache)
        world.cache.symlink_to(small_disk / "cache")
        (small_disk / "cache").mkdir()
    (small_disk / "filler").write_bytes(b"")
    with (small_disk / "filler").open("wb", buffering=0) as filler:
        free = shutil.disk_usage(small_disk).free
        filler.write(bytes(max(free - left, 0)))
    before = tree(small_disk)
    ended = world.run(*shlex.split(COMMANDS[name].format(disk=small_disk)))
    after = tree(small_disk)
    assert {n: after.get(n) for n in before} == before
    if ended[0] == 0:
        assert left, "it may be enough for a small file"
        return
    assert_refused(ended, "No space left on device")
    news = set(after) - set(before)
    assert not [
        n
        for n in news
        if not n.startswith(("new/", "new.svg", "stopped/trajectories/", "cache/key"))
    ]
    assert not {n for n in news if n.endswith((".csv", ".html"))}
    for campaign, cases in (("new", 0), ("stopped", 20)):
        if f"{campaign}/{OUTCOMES}" in after:
            assert len(Run(small_disk / campaign).outcomes) == cases


SETPRIV = shutil.which("setpriv")
WITHOUT_RIGHTS = (str(SETPRIV), "--bounding-set=-all", "--inh-caps=-all", "--no-new-privs")
"""So root is a user like any other: permissions hold for it, too."""


@pytest.fixture
def as_nobody(run, tmp_path):
    """Return a world, and what runs our command there without the rights of root."""
    root = os.geteuid() == 0
    require(not root or SETPRIV is not None, "as root it needs setpriv of util-linux")
    world = world_with(run, tmp_path / "world", prefix=WITHOUT_RIGHTS if root else ())
    (world.root / "closed").mkdir(mode=0o555)
    code, _, _ = world.run(script="open('closed/file', 'w')")
    require(code != 0, "permissions do not hold here")
    yield world, world.run
    for path in [world.root, *world.root.rglob("*")]:
        if path.is_dir():
            path.chmod(0o755)


def locked(folder: Path) -> None:
    for path in [folder, *folder.rglob("*")]:
        path.chmod(0o555 if path.is_dir() else 0o444)


@pytest.mark.long
class TestAFolderThatIsReadOnly:
    def test_of_a_run_is_read_and_never_written(self, as_nobody):
        world, ended = as_nobody
        locked(world.root / "run")
        before = tree(world.root / "run")
        for arguments in (
            ("report", "run"),
            ("campaign", "--resume", "run", "-q"),
            ("export", "run", "59"),
            ("export", "run", "--format", "csv"),
            ("probability", "run", "--cases", "4"),
        ):
            assert_refused(ended(*arguments), "cannot write")
        for allowed in (
            ("compare", "run", "run"),
            ("export", "run", "59", "--out", "elsewhere"),
            ("probability", "run", "--cases", "4", "--out", "p.json"),
        ):
            code, _, err = ended(*allowed)
            assert code == 0, err
        assert tree(world.root / "run") == before

    @pytest.mark.parametrize("writer", WRITERS)
    def test_to_write_to_is_named_before_the_first_case(self, as_nobody, writer):
        world, ended = as_nobody
        (world.root / "locked").mkdir(mode=0o555)
        command, suffix = WRITERS[writer]
        said = ended(*shlex.split(command), f"locked/new{suffix}")
        assert_refused(said, "cannot write", "Permission denied")
        assert not (world.root / "new").exists()

    def test_for_the_cache_costs_the_truth_and_no_campaign(self, as_nobody):
        world, ended = as_nobody
        locked(world.cache)
        assert_refused(ended(*TRUTH.split()), "cannot write")
        code, _, err = ended(*SMALL)
        assert code == 0, err

    def test_for_temporary_files_is_named(self, as_nobody):
        world, ended = as_nobody
        world.temporary.chmod(0o555)
        code, _, err = ended(*SMALL)
        assert "Traceback" not in err
        assert (code == 2 and "TMPDIR" in err) or code == 0, err


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
        gone = Vanishing(tmp_path / "run" / "trajectories", at=25)
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
