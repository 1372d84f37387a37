"""Every command that is printed runs as it stands: of the terminal, of pages, and of messages."""

from __future__ import annotations

import re
import shlex
import signal
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from lxml import html
from support.calling import Said
from support.campaigning import campaign_settings, run_campaign

import merge_sumo as ms
from merge_sumo.campaigns.printed_commands import campaign_command, command
from merge_sumo.interrupt import Stopped

Call = Callable[..., Said]

BAD_USE = 2
RUN = "a run's"
"""A folder whose name needs quotes."""
SOURCE = """
class MyVut:
    gain = 1.0

    def reset(self, seen):
        self.brakes = False

    def act(self, seen):
        gap_m = seen.x_pov_m - seen.x_vut_m
        self.brakes = self.brakes or (seen.x_vut_m > -60.0 and abs(gap_m) < 15.0)
        return -2.0 if self.brakes and seen.v_vut_mps > 10.0 else self.gain
"""
FEW = {"probability": ["--cases", "8"], "campaign": ["--cases", "4", "--level", "0"]}
"""Options with which the commands of the longest verbs take seconds."""
A_COMMAND = re.compile(r"(?:merge-sumo|ms\.\w+\(|&& merge-sumo).*")


def commands_in(text: str) -> Iterator[str]:
    """Yield the commands of lines, each at the end of one or between backticks."""
    for line in text.splitlines():
        for part in [*line.split("`")[1::2], line.rpartition(": ")[2]]:
            if A_COMMAND.fullmatch(part.strip()):
                yield part.strip()


def commands_on(page: Path, index: int) -> Iterator[str]:
    """Yield the commands of a page, as it shows them of a case."""
    tree: Any = html.fromstring(page.read_bytes())
    for place in tree.xpath("//code//span[@class='index']"):
        place.text = str(index)
    for code in tree.xpath("//code"):
        text = code.text_content()
        if A_COMMAND.fullmatch(text):
            yield text
    for lines in tree.xpath("//pre"):
        yield from commands_in(lines.text_content())


@pytest.fixture
def place(tmp_path, monkeypatch) -> Path:
    """Work in a folder with a controller of the user's own."""
    (tmp_path / "my_vut.py").write_text(SOURCE)
    monkeypatch.chdir(tmp_path)
    monkeypatch.delitem(sys.modules, "my_vut", raising=False)  # of another test
    monkeypatch.syspath_prepend(tmp_path)  # before folders of other tests
    return tmp_path


@pytest.fixture
def runs(command_line: Call) -> Callable[[set[str]], None]:
    """Return what runs commands, and fails where one is of bad use."""

    def run(found: set[str]) -> None:
        for text in sorted(found):
            for part in text.split(" && "):
                words = [word for word in shlex.split(part) if word != "--gui"]
                assert words.pop(0) == "merge-sumo", part
                few = [] if "--resume" in words else FEW.get(words[0], [])
                if "--level" in words:
                    few = few[:2]
                said = command_line(*words, *few)
                assert said.code != BAD_USE, (part, said.err)

    return run


def printed(vut: str, command_line: Call, *options: object) -> set[str]:
    """Return every command that a campaign and the verbs on it print."""
    few = ("--level", 0, "--cases", 6, "--seed", 1, "-q", *options)
    said = command_line("campaign", "--vut", vut, *few, "--fail-when", "t_end_s > 0", "--out", RUN)
    assert said.code == 0, said.err
    run = ms.open_run(RUN)
    worst = run.failures[0]["index"]
    found = set(commands_in(said.out))
    assert any(f"replay {shlex.quote(RUN)}" in one for one in found)
    on_page = set(commands_on(run.report_file, worst))
    (explain,) = (one for one in on_page if " explain " in one)
    on_page.remove(explain)  # it runs here
    found |= on_page
    for line in (
        explain,
        campaign_command("rerun", run.folder, run.settings, [worst]),
        f"merge-sumo rerun {shlex.quote(RUN)} 0 1 2 --vut fsm -q",
    ):
        said = command_line(*shlex.split(line)[1:])
        assert said.code != BAD_USE, said.err
        found |= {*commands_in(said.out), *commands_in(said.err)}

    def stop() -> None:
        raise Stopped(signal.SIGINT)

    stopped: dict[str, Any] = {"level": 0, "cases": 4, "batch": 2, "seed": 1, "progress": False}
    with pytest.raises(Stopped) as raised:
        ms.campaign(vut, **stopped, out="stopped", check=stop)
    resume = set(commands_in("\n".join(raised.value.__notes__)))
    ms.report("stopped")
    assert resume == {c for c in commands_on(Path("stopped", "report.html"), 0) if "--resume" in c}
    return found | resume | {campaign_command("run", run.folder, run.settings, worst)}


@pytest.mark.parametrize(
    ("vut", "options"),
    [
        ("design1", ()),
        pytest.param("my_vut.py:MyVut", ("--scenario", "us23-lane"), marks=pytest.mark.slow),
    ],
)
@pytest.mark.usefixtures("place")
def test_runs_of_a_controller(vut, options, command_line, runs):
    runs(printed(vut, command_line, *options))


@pytest.mark.slow
def test_runs_of_an_object_of_a_notebook(place):
    names: dict[str, Any] = {"__name__": "__main__", "ms": ms}
    exec(SOURCE, names)  # noqa: S102 (as a cell of a notebook)
    (here,) = (vut for name, vut in names.items() if name == "MyVut")
    few: dict[str, Any] = {"level": 0, "cases": 12, "seed": 1, "progress": False}
    with pytest.warns(UserWarning, match="MyVut is an object"):
        run = ms.campaign(here, **few, tolerated=0.1, out=RUN, fail_when="t_end_s > 0")
    worst = run.failures[0]["index"]
    found = set(commands_in("\n".join(run.lines()))) | set(commands_on(run.report_file, worst))
    assert f'ms.probability("{RUN}", vut=MyVut)' in found
    assert f'ms.explain("{RUN}", {worst}, vut=MyVut)' in found
    explained = ms.explain(run, worst, vut=here, progress=False)
    found |= set(commands_in("\n".join(explained.lines())))
    found |= {campaign_command("run", run.folder, run.settings, worst, at={"x_pov0_m": -250.0})}
    calls = {one for one in found if one.startswith("ms.")}
    assert len(calls) >= 3
    assert not any("here:" in one for one in found)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # of an object, as above
        for text in sorted(calls):
            if not text.startswith("ms.probability"):  # this takes long
                eval(text, names)  # noqa: S307 (what is printed to be evaluated)


class TestACommand:
    def test_names_an_object_as_its_process_does(self, monkeypatch):
        here = {"MyVut": type("MyVut", (), {}), "MyVut-2": object()}
        monkeypatch.setattr("merge_sumo.controllers.python.objects", here)
        for spec, said in {
            "here:MyVut": "MyVut",
            "here:MyVut-2": "MyVut(...)",
            "here:Gone-3": "Gone",
            "here:lambda": "vut",
            "here:MyVut?gain=2": '"here:MyVut?gain=2"',
        }.items():
            assert command("campaign", vut=spec) == f"ms.campaign(vut={said})"
        mixed = command("rerun", Path("run"), [1, 2], vut="a.py:B", pov="here:MyVut")
        assert mixed == 'ms.rerun("run", [1, 2], vut="a.py:B", pov=MyVut)'


def test_an_explanation_by_another_vut_names_it(command_line, tmp_path):
    settings = campaign_settings(
        vut="design1", levels=(0,), cases=4, sampler="uniform", fail_when="dx_m > 0"
    )
    run = run_campaign(settings, tmp_path / "run")
    said = command_line("explain", run.folder, "--vut", "design1?gap_m=30")
    assert said.code == 0, said.err
    assert "  before: design1; with design1?gap_m=30:\n" in said.out
    assert "so far" not in command_line("explain", run.folder).out


def test_an_option_has_its_name_of_the_command_line():
    assert command("rerun", "a", deadline_s=2.0) == "merge-sumo rerun a --deadline 2.0"
