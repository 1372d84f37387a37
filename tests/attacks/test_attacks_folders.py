"""Another user of the machine puts links and folders into the place of what we write.

The victim is who runs the tests, in a folder that everybody can write; what must not change is a
private folder of the victim's. The other user is a real second account.
"""

# mypy: no-strict-optional

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from attacks import tell
from campaigning import resume_campaign, run_campaign

from merge_sumo.campaigns import store
from merge_sumo.campaigns.ownership import note_run
from merge_sumo.campaigns.plan import resolve
from merge_sumo.campaigns.settings import CampaignSettings, settings_of
from merge_sumo.campaigns.store import OUTCOMES, SETTINGS, TRAJECTORIES, Run
from merge_sumo.errors import UserError
from merge_sumo.reports.report import REPORT
from merge_sumo.studies import probability
from merge_sumo.studies.probability import failure_probability
from merge_sumo.studies.run_study import RunStudy
from merge_sumo.system.anchors import SUPPORTED
from merge_sumo.system.folders import TEMPORARY, add_to, new_folder, replace_own, write_new
from merge_sumo.values.scenario import US23

pytestmark = pytest.mark.skipif(not SUPPORTED, reason="folders are held by descriptors on Linux")
SETTINGS_OF: dict[str, Any] = {"vut": "design1", "levels": (0,), "sampler": "uniform", "seed": 1}
ROUNDS = 300


def tree(folder: Path) -> dict[str, bytes | None]:
    return {
        str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None
        for path in sorted(folder.rglob("*"))
    }


@pytest.fixture
def private(tmp_path) -> Iterator[Path]:
    """Return a folder of the victim's with names that we write; it must stay as it is."""
    folder = tmp_path / "private"
    (folder / TRAJECTORIES).mkdir(parents=True)
    names = (SETTINGS, OUTCOMES, REPORT, "file", f"{TRAJECTORIES}/00001.npz")
    for name in names:
        (folder / name).write_text("mine")
    folder.chmod(0o700)
    before = tree(folder)
    yield folder
    assert tree(folder) == before


def put_link(name: str, target: str) -> None:
    """Put a link into the place of whatever has a name."""
    Path(name).rename(f"{name}-away")
    Path(name).symlink_to(target)


def made_by_us(folder: str) -> list[Path]:
    return [path for path in Path(folder).iterdir() if path.name.startswith(TEMPORARY)]


def put_link_for_new(folder: str, target: str) -> None:
    for path in made_by_us(folder):
        put_link(str(path), target)


def put_folder_for_new(folder: str, other: str) -> None:
    for path in made_by_us(folder):
        path.rename(Path(folder, "away"))
        Path(folder, other).rename(path)


class TestACampaign:
    @pytest.mark.parametrize("begin", [True, False])
    def test_whose_folder_is_swapped_writes_where_it_began(
        self, begin, common, private, other_account
    ):
        folder = common / "run"
        settings = CampaignSettings(**{"scenario": US23, **SETTINGS_OF}, cases=24, batch=6)
        if not begin:
            run_campaign(
                CampaignSettings(**{"scenario": US23, **SETTINGS_OF}, cases=6, batch=6), folder
            )
        swapped: list[None] = []

        def swap() -> None:
            if not swapped:
                swapped.append(other_account(put_link, str(folder), str(private)))

        def run() -> None:
            if begin:
                run_campaign(settings, folder, check=swap)
            else:
                resume_campaign(folder, given={"cases": 24}, check=swap)

        with pytest.raises(UserError):  # in the end it is to be read by its name
            run()
        assert swapped
        assert len(Run(common / "run-away").outcomes) == 24

    def test_that_is_swapped_before_it_has_its_name_is_not_written_elsewhere(
        self, common, private, other_account, monkeypatch
    ):

        def swap(*arguments: Any, **named: Any) -> None:
            other_account(put_link_for_new, str(common), str(private))
            note_run(*arguments, **named)

        monkeypatch.setattr(store, "note_run", swap)
        settings = CampaignSettings(**{"scenario": US23, **SETTINGS_OF}, cases=2, batch=2)
        with pytest.raises(UserError):
            run_campaign(settings, common / "run")


class TestANewFolder:
    def filled(self, folder: Path, meanwhile: Callable[[], None]) -> None:
        """Fill a new folder, in which something goes wrong in the end."""
        with new_folder(folder) as new:
            meanwhile()
            (new / "file").write_text("ours")
            raise OSError(5, "failed")

    def test_that_becomes_a_link_is_filled_where_it_was_made(self, common, private, other_account):
        def swap() -> None:
            other_account(put_link_for_new, str(common), str(private))

        with pytest.raises(UserError, match="failed"):
            self.filled(common / "new", swap)

    def test_that_fails_removes_no_other_folder_of_ours(self, common, private, other_account):
        (common / "thesis").mkdir()
        (common / "thesis" / "text").write_text("mine")

        def swap() -> None:
            other_account(put_folder_for_new, str(common), "thesis")

        with pytest.raises(UserError, match="failed"):
            self.filled(common / "new", swap)
        (found,) = made_by_us(str(common))
        assert (found / "text").read_text() == "mine"
        assert not (found / "file").exists()


WRITERS: dict[str, Callable[[Path], None]] = {
    "new": lambda path: write_new(path, b"ours"),
    "own": lambda path: replace_own(path, b"ours"),
    "more": lambda path: add_to(path, b"ours", new=False),
}


class TestAFile:
    @pytest.mark.parametrize("how", WRITERS)
    def test_behind_a_link_of_another_user_is_not_written(
        self, how, common, private, other_account
    ):
        (common / "out").mkdir()
        other_account(put_link, str(common / "out"), str(private))
        for path in (common / "out" / REPORT, common / "out" / "new" / ".." / SETTINGS):
            with pytest.raises(UserError, match=r"cannot write|exists"):
                WRITERS[how](path)
        with pytest.raises(UserError, match=r"somebody else has made the link out|exists"):
            WRITERS[how](common / "out" / REPORT)

    @pytest.mark.parametrize("how", WRITERS)
    def test_that_is_a_link_is_not_written(self, how, common, private, other_account):
        other_account(lambda path, target: Path(path).symlink_to(target),
                      str(common / "file"), str(private / "file"))  # fmt: skip
        with pytest.raises(UserError):
            WRITERS[how](common / "file")

    def test_behind_a_link_of_ones_own_is_written(self, common):
        (common / "out").mkdir()
        (common / "link").symlink_to("out")
        (common / "further").symlink_to(common / "link")
        write_new(common / "further" / "file", b"ours")
        replace_own(common / "link" / "file", b"theirs")
        assert (common / "out" / "file").read_bytes() == b"theirs"

    def test_behind_links_that_go_round_is_refused(self, common):
        (common / "one").symlink_to("two")
        (common / "two").symlink_to("one")
        with pytest.raises(UserError, match="cannot write"):
            write_new(common / "one" / "file", b"ours")


def flip(folder: str, private: str) -> None:
    """Let the name of the folder in which we write be a link, and the folder again."""
    out, away = Path(folder, "out"), Path(folder, "away")
    out.rename(away)
    out.symlink_to(private)
    out.unlink()
    away.rename(out)


def flip_new(folder: str, private: str) -> None:
    for path in made_by_us(folder):
        put_link(str(path), private)


def test_a_race_of_links_writes_nothing_elsewhere(common, private, other_account):
    (common / "out").mkdir()
    (common / "out").chmod(0o777)
    done = {"written": 0, "refused": 0}
    with other_account.meanwhile(flip, str(common), str(private)):
        for number in range(ROUNDS):
            for write in (
                lambda n: replace_own(common / "out" / REPORT, b"ours"),
                lambda n: write_new(common / "out" / f"{n}.new", b"ours"),
                lambda n: add_to(common / "out" / f"{n}.jsonl", b"ours", new=True),
            ):
                try:
                    write(number)
                    done["written"] += 1
                except UserError:
                    done["refused"] += 1
    assert done["written"]
    tell(done, "race in a folder: ")  # type: ignore[arg-type]


def test_a_race_for_new_folders_writes_nothing_elsewhere(common, private, other_account):
    done = {"made": 0, "refused": 0}
    with other_account.meanwhile(flip_new, str(common), str(private)):
        for number in range(ROUNDS):
            try:
                with new_folder(common / f"run-{number}") as new:
                    for name in (SETTINGS, OUTCOMES, "file"):
                        (new / name).write_text("ours")
                done["made"] += 1
            except UserError:
                done["refused"] += 1
    tell(done, "race for new folders: ")  # type: ignore[arg-type]
    assert sum(done.values()) == ROUNDS


class TestTheCasesOfAProbability:
    @pytest.fixture
    def study(self, run, monkeypatch) -> RunStudy:
        monkeypatch.setattr(probability, "WRITTEN", 5)
        settings = settings_of(run.folder, run.settings)
        return RunStudy(run, settings, resolve(settings))

    def test_that_somebody_changes_do_not_change_the_estimate(self, study, tmp_path):
        honest = failure_probability(study, tmp_path / "honest.json", cases=20)
        tampered = tmp_path / "tampered.jsonl"

        def tamper(_: int) -> None:
            if tampered.exists():
                lines = tampered.read_text().replace('"failed": true', '"failed": false')
                tampered.write_text("{}\n" + lines.replace("-", ""))

        tampering = replace(study, on_cases=tamper)
        found = failure_probability(tampering, tmp_path / "tampered.json", cases=20)
        assert found == honest
        read = [(tmp_path / f"{name}.json").read_text() for name in ("honest", "tampered")]
        assert read[0] == read[1]

    def test_that_become_a_link_are_written_nowhere_else(
        self, study, common, private, other_account
    ):
        lines = common / "p.jsonl"

        def swap(_: int) -> None:
            if lines.exists() and not lines.is_symlink():
                other_account(put_link, str(lines), str(private / "file"))

        with pytest.raises(UserError, match="cannot write"):
            failure_probability(replace(study, on_cases=swap), common / "p.json", cases=20)

    def test_that_are_there_before_are_neither_read_nor_replaced(self, study, tmp_path):
        lines = tmp_path / "p.jsonl"
        lines.write_text('{"index": 0, "failed": false}\n' * 20)
        with pytest.raises(UserError, match="exists"):
            failure_probability(study, tmp_path / "p.json", cases=20)
        assert not (tmp_path / "p.json").exists()
        shutil.copy(lines, tmp_path / "kept")
        assert lines.read_bytes() == (tmp_path / "kept").read_bytes()
