"""A notebook in a real kernel: VUTs that a cell defines, and what a person sees of what runs."""

from __future__ import annotations

import importlib.util

import pytest
from conftest import require

pytestmark = pytest.mark.long

VUTS = """
import os, signal
import merge_sumo as ms

class MyVut:
    def act(self, seen):
        return 0.5

class Batched:
    def __init__(self, corridors=1):
        pass

    def act_batch(self, seen):
        return 0.0 * seen.t_s + 0.5

small = {"level": 0, "cases": 20, "batch": 5, "seed": 1, "sampler": "subset"}
ms.campaign(MyVut, **small, progress=False, out='whole')

def stop(outcome):
    if outcome.index == 12:
        os.kill(os.getpid(), signal.SIGINT)
"""


class Notebook:
    """Cells run one by one in one kernel."""

    def __init__(self, client) -> None:
        self._client = client

    def run(self, source: str) -> list:
        """Run a cell and return what it shows."""
        from nbformat.v4 import new_code_cell

        cells = self._client.nb.cells
        cells.append(new_code_cell(source))
        return self._client.execute_cell(cells[-1], len(cells) - 1)["outputs"]

    def value(self, source: str) -> dict[str, str]:
        """Return what the last line of a cell is shown as, by kind."""
        (shown,) = (o for o in self.run(source) if o["output_type"] == "execute_result")
        return shown["data"]

    def said(self, source: str) -> str:
        """Return what a cell says on standard error."""
        return "".join(o["text"] for o in self.run(source) if o.get("name") == "stderr")

    def error(self, source: str) -> str:
        """Return the traceback that a cell ends with."""
        (error,) = (o for o in self.run(source) if o["output_type"] == "error")
        return "\n".join(error["traceback"])


@pytest.fixture(scope="module")
def notebook(tmp_path_factory):
    for package in ("nbclient", "ipykernel"):
        require(importlib.util.find_spec(package) is not None, f"{package} is not installed")
    from nbclient import NotebookClient
    from nbformat.v4 import new_notebook

    folder = tmp_path_factory.mktemp("notebook")
    client = NotebookClient(
        new_notebook(),
        timeout=600,
        allow_errors=True,
        kernel_name="python3",
        resources={"metadata": {"path": str(folder)}},
    )
    with client.setup_kernel(cwd=str(folder)):
        opened = Notebook(client)
        assert not any(o["output_type"] == "error" for o in opened.run(VUTS))
        yield opened


def test_a_campaign_shows_lines_and_its_table(notebook):
    outputs = notebook.run("run = ms.campaign(MyVut, **small, out='run')\nrun")
    (shown,) = (o["data"] for o in outputs if o["output_type"] == "execute_result")
    assert shown["text/plain"].startswith("<campaign run: ")
    assert "<pre>" in shown["text/html"]
    warning = "".join(o["text"] for o in outputs if o["output_type"] == "stream")
    assert "here:MyVut v level 0: " in warning
    assert "MyVut is known to this process alone, so it drives here" in warning


@pytest.mark.parametrize("vut", ["lambda seen: 0.5", "MyVut()", "Batched()", "Batched"])
@pytest.mark.parametrize("workers", [1, 2])
def test_what_a_cell_can_define_drives_the_same(notebook, vut, workers):
    name = f"{vut.partition(' ')[0].strip('()')}-{'()' in vut:d}-{workers}"
    source = f"other = ms.campaign({vut}, **small, workers={workers}, out={name!r})\n"
    same = notebook.value(source + "list(other.cases) == list(ms.open_run('whole').cases)")
    assert same["text/plain"] == "True"


def test_an_interrupted_campaign_says_how_to_go_on_and_does(notebook):
    stopped = notebook.error(
        "run = ms.campaign(MyVut, **small, progress=False, on_case=stop, out='stopped')"
    )
    assert "stopped; go on with ms.resume('stopped')" in stopped
    assert notebook.value("len(ms.open_run('stopped').cases)")["text/plain"] == "10"
    outputs = notebook.run("done = ms.resume('stopped')\ndone")
    said = "".join(o["text"] for o in outputs if o["output_type"] == "stream")
    assert "here:MyVut v level 0: " in said
    same = notebook.value("list(ms.open_run('whole').cases) == list(done.cases)")
    assert same["text/plain"] == "True"
    more = notebook.value("len(ms.resume('stopped', cases=30).cases)")
    assert more["text/plain"] == "30"


@pytest.mark.parametrize(
    ("source", "shown"),
    [
        ("ms.run(MyVut, level=0, x_pov0_m=-300, v_pov0_mps=33)", "<case: "),
        ("ms.truth(MyVut, 0, cases=20)", "<TruthResult: "),
        ("ms.compare(['whole', 'whole'], out='page.html')", "<Comparison: 0 cases broke"),
        ("ms.rerun('whole', [0, 1], vut=MyVut)", "<Comparison: "),
        ("ms.open_run('whole').trajectory(0)", "<Trajectory: 2 vehicles, "),
        ("ms.export('whole', [0])", "[PosixPath('whole/scenarios/case-00000/replay.sumocfg')]"),
    ],
)
def test_what_comes_back_is_shown_in_short(notebook, source, shown):
    value = notebook.value(source)
    assert value["text/plain"].startswith(shown)
    assert len(value["text/plain"]) < 200


def test_what_is_asked_for_wrongly_is_a_sentence(notebook):
    assert notebook.error("ms.campaign('design2', level=7)") == (
        "UserError: there is no POV level '7': choose 0, 1, 2 or all, or own with --pov"
    )
