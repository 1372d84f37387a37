"""A replay folder or a net that somebody sent is data, whatever it holds.

Each attack changes one thing in an honest file: it asks for a file to be written or read, for an
address, for memory or time without end. SUMO itself is real.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from support.processes import cpu_s

from merge_sumo.errors import UserError
from merge_sumo.road.merge import default_net_path, road_of
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo import mirror
from merge_sumo.sumo import replay as replay_module
from merge_sumo.sumo.binding import run_program
from merge_sumo.sumo.opendrive import opendrive
from merge_sumo.sumo.replay import Replay, open_gui, replay
from merge_sumo.sumo.replay_folder import CASE, CONFIG, HOSTED_NET, LABELS, RECORD, TYPES, VIEW
from merge_sumo.sumo.world import World

HONEST = Path(__file__).resolve().parents[2] / "scenarios" / "roundabout-yields"
LIMIT_S = 40.0
"""Of CPU time."""
SECRET = "what-only-the-user-knows"  # noqa: S105 (of nobody)
RUNNABLE = {CONFIG, HOSTED_NET, TYPES, LABELS, RECORD, VIEW}
READ = (CASE, HOSTED_NET, RECORD)
"""The files that a replay reads."""

Edit = Callable[[str], str]


def instead(old: str, new: str) -> Edit:
    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return edit


def first(text: str) -> Edit:
    """Put text behind the start tag of the root."""
    return lambda old: re.sub(r"(<(?!\?)[\w-]+[^>]*>)", lambda found: found[0] + text, old, count=1)


def bomb(declaration: str) -> Edit:
    def edit(text: str) -> str:
        (head, body), *_ = re.findall(r"^(<\?xml.*?\?>)?(.*)", text, re.DOTALL)
        return (head or "") + declaration + first("&a9;" * 50)(body)

    return edit


LAUGHS = "".join(f"<!ENTITY a{n} '{f'&a{n - 1};' * 10}'>" for n in range(1, 10))
BOMBS = {
    "billion laughs": bomb(f"<!DOCTYPE l [<!ENTITY a0 'ha'>{LAUGHS}]>"),
    "a file as an entity": bomb('<!DOCTYPE l [<!ENTITY a9 SYSTEM "file://{SECRET}">]>'),
    "an address as an entity": bomb('<!DOCTYPE l [<!ENTITY % p SYSTEM "http://{HOST}/x"> %p;]>'),
}
ADDED = {
    "edgeData": first('<edgeData id="a" file="{VICTIM}" freq="1"/>'),
    "a detector": first('<e2Detector id="a" lane="ramp_0" pos="1" endPos="9" file="{VICTIM}"/>'),
    "an address": first('<include href="http://{HOST}/a.xml"/>'),
    "an XInclude": first(
        '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="{SECRET}"/>'
    ),
    "an instruction": first('<?include href="{SECRET}"?>'),
    "a light with a log": first(
        '<tlLogic id="M" type="actuated" programID="0" offset="0"><param key="file" '
        'value="{VICTIM}"/><phase duration="9" state="G"/></tlLogic>'
    ),
}
OF_A_NET = ADDED | {
    "a million edges": first('<edge id="e"/>' * 4_000_001),
    "a name of 11 MB": first(f'<a b="{"x" * 11_000_000}"/>'),
    "a coordinate that is nan": instead(' shape="', ' shape="nan,0 '),
    "a coordinate that is huge": instead('shape="', 'shape="1e300,0 '),
    "a length of nothing": lambda text: text.replace(' length="', ' length="-'),
    "a depth without end": first("<a>" * 100_000),
}
OF_A_RECORD = {
    "a speed that is nan": instead(' speed="', ' speed="nan" was="'),
    "a far place": instead(' pos="', ' pos="1e300" was="'),
    "a far time": instead('time="0.10"', 'time="9e99"'),
    "no car in a row": lambda text: re.sub(
        r'(time="2.00">).*?(</timestep>)', r"\1\2", text, flags=re.DOTALL
    ),
    "a lane that leads elsewhere": instead(' lane="', ' lane="{SECRET}" was="'),
}
OF_A_CASE = {
    "no JSON": lambda _: "[" * 100_000,
    "another end": instead('"t_end_s": ', '"t_end_s": 1e9, "was": '),
    "an unknown field": instead('"index"', '"{SECRET}": 1, "index"'),
    "a text as a number": instead('"level": 1', '"level": "1"'),
    "half a character": instead('"MERGED"', '"\\ud800"'),
}
TEXTS: dict[str, tuple[str, Edit]] = {}
for _file, _edits in {
    HOSTED_NET: OF_A_NET | BOMBS,
    RECORD: ADDED | OF_A_RECORD | BOMBS,
    CASE: OF_A_CASE,
}.items():
    TEXTS |= {f"{name} in {_file}": (_file, edit) for name, edit in _edits.items()}
WITHOUT_EFFECT = {f"{name} in {file}" for name in ADDED for file in (HOSTED_NET, RECORD)}
"""What is added is dropped; every other attack is refused."""


def anew(make: Callable[[Path], object]) -> Callable[[Path], object]:
    def instead_of(path: Path) -> None:
        path.unlink()
        make(path)

    return instead_of


IN_PLACE: dict[str, Callable[[Path], object]] = {
    "a FIFO": anew(os.mkfifo),
    "a folder": anew(Path.mkdir),
    "a file of a terabyte": lambda path: os.truncate(path, 2**40),
    "a link to a secret": anew(lambda path: path.symlink_to("../home/secret.xml")),
    "a link to zeroes": anew(lambda path: path.symlink_to("/dev/zero")),
    "UTF-16": lambda path: path.write_text(path.read_text(), encoding="utf-16"),
    "bytes of no text": lambda path: path.write_bytes(bytes(range(256)) * 100),
}
FILES = {
    f"{name} in the place of {file}": (file, make)
    for name, make in IN_PLACE.items()
    for file in READ
}


class Scene:
    """The folder that was sent, and what of the user's an attack aims at."""

    def __init__(self, root: Path, listener: socket.socket) -> None:
        self.root, self.listener, self.folder = root, listener, root / "sent"
        self.names = {
            "{VICTIM}": str(root / "home" / "thesis.txt"),
            "{SECRET}": str(root / "home" / "secret.xml"),
            "{HOST}": f"127.0.0.1:{listener.getsockname()[1]}",
        }
        self.started: list[str] = []

    def attack(self, name: str, folder: Path | None = None) -> None:
        """Make a folder hostile."""
        folder = folder or self.folder
        if name in FILES:
            file, make = FILES[name]
            make(folder / file)
            return
        file, edit = TEXTS[name]
        text = edit((folder / file).read_text(encoding="utf-8"))
        for placeholder, value in self.names.items():
            text = text.replace(placeholder, value)
        (folder / file).write_text(text, encoding="utf-8")

    def tree(self) -> dict[str, tuple[int, int, int]]:
        """Return kind, size and time of everything below; the temporary folder must be empty."""
        found = {}
        for path in sorted(set(self.root.rglob("*")) - {self.root / "tmp"}):
            status = path.lstat()
            found[str(path)] = status.st_mode, status.st_size, status.st_mtime_ns
        return found

    def come_to(self, act: Callable[[], object]) -> object:
        """Return what an attack comes to: a result, or the sentence that refuses it."""
        before, before_s = self.tree(), cpu_s()
        try:
            result = act()
        except UserError as error:
            result = str(error)
            assert "\n" not in result
            assert 0 < len(result) < 1000
            assert SECRET not in result
        assert cpu_s() - before_s < LIMIT_S
        assert self.tree() == before
        assert list((self.root / "tmp").iterdir()) == []
        with pytest.raises(BlockingIOError):
            self.listener.accept()
        return result


@pytest.fixture
def scene(tmp_path, monkeypatch) -> Iterator[Scene]:
    """Plant the files of a user, listen on an address, and look at what SUMO is started on."""
    for name in ("home", "tmp"):
        (tmp_path / name).mkdir()
    (tmp_path / "home" / "thesis.txt").write_text("ten years of work")
    (tmp_path / "home" / "secret.xml").write_text(f"<{SECRET}>{SECRET}</{SECRET}>")
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    shutil.copytree(HONEST, tmp_path / "sent")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        scene = Scene(tmp_path, listener)

        def looked_at(name: str, arguments: list[str], stage: Path, **options: Any) -> object:
            assert {path.name for path in stage.iterdir()} == RUNNABLE
            for path in stage.iterdir():
                assert not path.is_symlink()
                text = path.read_text(encoding="utf-8")
                assert not [word for word in (str(tmp_path / "home"), SECRET, "//") if word in text]
            scene.started.append(name)
            if name == "sumo-gui":
                name, options = "sumo", {}
            return run_program(name, arguments, stage, **options)

        monkeypatch.setattr(replay_module, "run_program", looked_at)
        yield scene


SOME = [
    name if number % 3 == 0 else pytest.param(name, marks=pytest.mark.long)
    for number, name in enumerate([*TEXTS, *FILES])
]
"""Each third: attacks of a kind stand next to each other."""


@pytest.mark.parametrize("name", SOME)
def test_a_hostile_folder_does_nothing_and_gets_a_sentence_or_a_true_result(scene, name):
    scene.attack(name)
    result = scene.come_to(lambda: replay(scene.folder))
    if name in WITHOUT_EFFECT:
        assert isinstance(result, Replay)
        assert result.identical
    else:
        assert str(scene.folder) in str(result)
    assert len(scene.started) == (name in WITHOUT_EFFECT)


@pytest.mark.parametrize("file", [CONFIG, TYPES, LABELS, VIEW])
def test_files_that_a_replay_writes_itself_are_not_read(scene, file, monkeypatch):
    (scene.folder / file).write_text("<configuration><report><log value='/tmp/x'/></report>")
    result = scene.come_to(lambda: replay(scene.folder))
    assert isinstance(result, Replay)
    assert result.identical
    monkeypatch.setenv("DISPLAY", "127.0.0.1:0")
    assert scene.come_to(lambda: open_gui(scene.folder)) == 0
    assert scene.started == ["sumo", "sumo-gui"]


NETS = {name: edit for name, (file, edit) in TEXTS.items() if file == HOSTED_NET} | {
    "a projection of a file": instead('"!"', '"+proj=utm +nadgrids={SECRET}"'),
    "a schema of its own": instead("http://sumo.dlr.de/xsd/net_file.xsd", "http://{HOST}/net.xsd"),
}
HARMLESS = {*WITHOUT_EFFECT, "a projection of a file", "a schema of its own"}


@pytest.mark.parametrize("name", NETS)
def test_of_a_hostile_net_nothing_reaches_sumo_or_an_export(scene, name):
    """As a scenario names it, with every kind of controller."""
    text = NETS[name](default_net_path().read_text())
    for placeholder, value in scene.names.items():
        text = text.replace(placeholder, value)
    path = scene.folder / "hostile.net.xml"
    path.write_text(text)
    (scene.folder / "shadow").mkdir()
    for file in (mirror.NET, mirror.TYPES, mirror.ROAD):
        (scene.folder / "shadow" / file).touch()

    def use() -> bytes:
        road = road_of(path)
        with World(1, road, scenario=US23) as world:
            world.advance()
        return opendrive(road)

    result = scene.come_to(use)
    assert isinstance(result, bytes) == (name in HARMLESS), result
    if name in HARMLESS:
        mirror.write_files(scene.folder / "shadow", road_of(path), US23)
        for content in (result, (scene.folder / "shadow" / mirror.NET).read_bytes()):
            assert not [
                word for word in (*scene.names.values(), SECRET) if word.encode() in content
            ]
