"""The cache folder and the key in it: only what this user wrote is believed."""

from __future__ import annotations

import os
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from campaigning import campaign_settings, resume_campaign, run_campaign
from plans import plan_for

from merge_sumo.errors import UserError
from merge_sumo.studies.truth import ground_truth
from merge_sumo.system.signature import KEY, KEY_BYTES, signed, user_key, verified

CASES = 40
TRUTH = ("truth", "--vut", "design1", "--level", "0", "--cases", CASES, "--workers", "1")


@pytest.fixture
def cache(tmp_path, monkeypatch) -> Path:
    """Return the cache of a user who has none yet."""
    monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


def refuses(said: tuple[int, str, str], *words: str) -> bool:
    code, _, err = said
    return code == 2 and err.count("\n") == 1 and all(word in err for word in words)


class TestAKey:
    def test_is_the_users_alone_and_stays(self, cache):
        key = user_key()
        assert len(key) == KEY_BYTES
        assert cache.stat().st_mode & 0o777 == 0o700
        assert (cache / KEY).stat().st_mode & 0o777 == 0o600
        assert [file.name for file in cache.iterdir()] == [KEY]
        assert user_key() == key

    def test_of_another_user_is_another(self, cache, monkeypatch, tmp_path):
        key = user_key()
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(tmp_path / "other"))
        assert user_key() != key

    @pytest.mark.parametrize("torn", [b"", b"short", b"x" * 33])
    def test_that_is_torn_is_said_in_a_sentence(self, cache, torn, command_line):
        user_key()
        (cache / KEY).write_bytes(torn)
        assert refuses(command_line(*TRUTH), "is not as it was written: remove it")
        (cache / KEY).unlink()
        assert command_line(*TRUTH)[0] == 0

    def test_that_others_can_read_is_not_used(self, cache, command_line):
        user_key()
        (cache / KEY).chmod(0o644)
        assert refuses(command_line(*TRUTH), "others can read it: remove it")

    @pytest.mark.parametrize("kind", ["link", "pipe", "folder"])
    def test_that_is_no_file_is_not_used(self, cache, tmp_path, kind):
        user_key()
        (cache / KEY).unlink()
        if kind == "link":
            (tmp_path / "planted").write_bytes(b"k" * KEY_BYTES)
            (tmp_path / "planted").chmod(0o600)
            (cache / KEY).symlink_to(tmp_path / "planted")
        elif kind == "pipe":
            os.mkfifo(cache / KEY, 0o600)
        else:
            (cache / KEY).mkdir(0o700)
        with pytest.raises(UserError, match="your key"):
            user_key()

    @pytest.mark.parametrize("links", [True, False])
    def test_made_by_many_processes_at_once_is_one(self, cache, links):
        """Also where the file system has no hard links: there the slower ones find it torn."""
        script = (
            "import os, sys, time\n"
            "from merge_sumo.system.signature import user_key\n"
            f"if not {links}:\n"
            "    def link(*_, **__): raise PermissionError\n"
            "    os.link = link\n"
            "sys.stdin.read(1)\n"
            "print(user_key().hex())\n"
        )
        command = [sys.executable, "-c", script]
        pipe = subprocess.PIPE
        many = [subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe) for _ in range(6)]
        for one in many:
            assert one.stdin is not None
            one.stdin.write(b"x")
            one.stdin.flush()
        keys = [one.communicate()[0] for one in many]
        assert {key for key in keys if key} == {user_key().hex().encode() + b"\n"}
        assert all(keys) or not links

    def test_of_which_the_writer_is_killed_is_made_by_the_next_one(self, cache):
        script = (
            "import os, signal\n"
            "from merge_sumo.system.signature import user_key\n"
            "os.fsync = lambda _: os.kill(os.getpid(), signal.SIGKILL)\n"
            "user_key()\n"
        )
        ended = subprocess.run([sys.executable, "-c", script], check=False)
        assert ended.returncode == -signal.SIGKILL
        assert not (cache / KEY).exists()
        assert len(user_key()) == KEY_BYTES


def test_a_signature_is_of_one_content_under_one_name_by_one_key():
    key = b"k" * KEY_BYTES
    content = signed(b"what", "name", key)
    assert verified(content, "name", key) == b"what"
    assert verified(content, "nam", key) is None
    assert verified(content, "name", b"j" * KEY_BYTES) is None
    assert verified(signed(b"ewhat", "nam", key), "name", key) is None
    assert verified(b"", "name", key) is None
    for place in range(len(content)):
        spoilt = bytearray(content)
        spoilt[place] ^= 1
        assert verified(bytes(spoilt), "name", key) is None


class TestACacheThatOthersCanWrite:
    def test_is_refused_where_a_truth_is_to_be_kept_there(self, cache, command_line):
        assert command_line(*TRUTH)[0] == 0
        cache.chmod(0o777)
        said = command_line(*TRUTH)
        assert refuses(said, "others can write the cache folder", f"chmod go-w {cache}")
        cache.chmod(0o755)
        assert command_line(*TRUTH)[0] == 0

    def test_stops_no_campaign_and_vouches_for_none(self, cache, tmp_path, monkeypatch):
        cache.mkdir()
        cache.chmod(0o777)
        (tmp_path / "my_vut.py").write_text("def Vut(seen):\n    return 0.0\n")
        monkeypatch.chdir(tmp_path)
        settings = campaign_settings(vut="my_vut.py:Vut", cases=2, sampler="uniform")
        run = run_campaign(settings, tmp_path / "run")
        with pytest.raises(UserError, match=r"chmod go-w .*--trust-vut"):
            resume_campaign(run.folder)
        assert [*cache.iterdir()] == []

    def test_by_its_group_is_refused_unless_the_group_is_the_users_alone(
        self, cache, other_account
    ):
        user_key()
        cache.chmod(0o775)
        user_key()  # of root's own group
        os.chown(cache, -1, other_account.gid)
        with pytest.raises(UserError, match="others can write"):
            user_key()


class TestASecondAccount:
    """Another user of this machine, who made the cache folder, or wrote into it."""

    def test_whose_folder_it_is_forges_nothing(
        self, common, other_account, command_line, monkeypatch
    ):
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(common / "cache"))

        def plant(folder: str) -> None:
            Path(folder).mkdir()
            Path(folder).chmod(0o777)
            Path(folder, KEY).write_bytes(b"k" * KEY_BYTES)
            Path(folder, KEY).chmod(0o600)

        other_account(plant, str(common / "cache"))
        assert refuses(command_line(*TRUTH), f"belongs to {other_account.name}")
        assert [path.name for path in (common / "cache").iterdir()] == [KEY]

    def test_that_plants_a_key_in_a_folder_that_was_open_forges_nothing(
        self, common, other_account, command_line, monkeypatch
    ):
        cache = common / "cache"
        cache.mkdir()
        cache.chmod(0o777)
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(cache))

        def plant(folder: str) -> None:
            Path(folder, KEY).write_bytes(b"k" * KEY_BYTES)
            Path(folder, KEY).chmod(0o600)

        other_account(plant, str(cache))
        assert refuses(command_line(*TRUTH), "others can write")
        cache.chmod(0o755)  # as it was told; what was planted stays
        assert refuses(command_line(*TRUTH), "is somebody else's", "remove it")
        (cache / KEY).unlink()
        assert command_line(*TRUTH)[0] == 0

    def test_with_a_cache_of_its_own_does_not_believe_ours(
        self, common, other_account, monkeypatch
    ):
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(common / "mine"))
        truth = ground_truth(plan_for("design1"), 0, CASES)
        shutil.copytree(common / "mine", common / "copy")
        (common / "copy" / KEY).unlink()  # nobody else can read it
        monkeypatch.setenv("MERGE_SUMO_CACHE", str(common / "copy"))
        counted: list[int] = []
        again = ground_truth(plan_for("design1"), 0, CASES, on_cases=counted.append)
        assert sum(counted) == CASES
        assert np.array_equal(again.score, truth.score)

        def read(path: str) -> bool:
            return bool(Path(path).read_bytes())

        with pytest.raises(OSError, match="PermissionError"):
            other_account(read, str(common / "mine" / KEY))
