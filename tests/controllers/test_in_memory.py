"""VUTs as Python has them: classes, functions, lambdas and objects; and where they may drive."""

from __future__ import annotations

import subprocess
import sys
from typing import Any

import pytest

import merge_sumo as ms
from merge_sumo.controllers.in_memory import is_in_process, spec_of
from merge_sumo.controllers.kinds import load

SMALL: dict[str, Any] = {"level": 0, "cases": 4, "seed": 1}


class Steady:
    """Keeps its speed."""

    def act(self, _seen):
        return 0.0


class Batched:
    """Accelerates by what it was made with, in all corridors."""

    def __init__(self, a_mps2: float) -> None:
        self.a_mps2, self.asked = a_mps2, 0

    def act_batch(self, seen):
        self.asked += 1
        return 0.0 * seen.t_s + self.a_mps2


def steady(_seen):
    return 0.0


class TestASpec:
    @pytest.mark.parametrize("vut", [Steady, steady])
    def test_of_what_can_be_imported_is_its_name(self, vut):
        assert spec_of(vut) == f"{__name__}:{vut.__name__}"

    def test_of_another_object_of_the_same_name_is_another(self):
        specs = [spec_of(lambda _: 0.0), spec_of(lambda _: 1.0)]
        assert len(set(specs)) == 2
        assert all(map(is_in_process, specs))

    @pytest.mark.parametrize("thing", [None, object(), type("Nothing", (), {}), lambda: 0.0])
    def test_of_another_object_is_refused(self, thing):
        with pytest.raises(ms.UserError, match=r"a VUT is a class|must accept the call"):
            load(spec_of(thing))

    def test_that_was_an_object_of_another_process_says_so(self):
        with pytest.raises(ms.UserError, match="was an object of a Python process"):
            ms.run("here:gone", x_pov0_m=-300, v_pov0_mps=30)


class TestACampaign:
    def test_asks_the_very_object_that_it_was_given(self, tmp_path):
        vut = Batched(1.0)
        with pytest.warns(UserWarning, match=r"Batched\S* is an object: .* in this process"):
            run = ms.campaign(vut, **SMALL, workers=2, out=tmp_path / "run")
        assert vut.asked > 50
        assert run.trajectory(0).a_vut_mps2[0] == 1.0


@pytest.mark.slow
def test_workers_need_no_main_guard_and_no_file(tmp_path):
    """Without a guard, a worker that imported the script would run the campaign again."""
    script = (
        "import merge_sumo as ms\n"
        "run = ms.campaign('design2', level=0, cases=4, batch=2, sampler='uniform',\n"
        "    workers=2, out='run')\n"
        "print(repr(run))\n"
    )
    command = [sys.executable, "-"]
    done = subprocess.run(
        command, input=script, cwd=tmp_path, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == "<campaign run: 0 failures in 4 cases>\n"
