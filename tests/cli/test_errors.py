"""A mistyped name is answered with its place and the nearest known name."""

from __future__ import annotations

from functools import partial

import pytest

from merge_sumo import api, cli
from merge_sumo.controllers.kinds import load
from merge_sumo.controllers.signatures import check_call, check_methods
from merge_sumo.errors import UserError
from merge_sumo.road.scenario_file import named_scenario
from merge_sumo.samplers.registry import make_sampler
from merge_sumo.scenario.case import Pool
from merge_sumo.scenario.scenario import US23


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: load("desgin2"), "did you mean design2"),
        (lambda: load(""), "no VUT is named: set `vut` to one of careful, "),
        (lambda: make_sampler("unifrom", Pool(levels=(0,), scenario=US23), 0), "mean uniform"),
        (lambda: named_scenario("us23-trafic"), "choose us23"),
    ],
)
def test_an_unknown_name_is_answered_with_the_nearest(make, said):
    with pytest.raises(UserError, match=said):
        make()


class TestAWrongSignature:
    @pytest.mark.parametrize(
        ("source", "said"),
        [
            (
                "class V:\n\n    def act(self):\n        return 0.0\n",
                "act(self) must accept the call act(self, seen)",
            ),
            (
                "class V:\n    def act_batch(self, seen): ...\n    def reset(self, seen): ...\n",
                "reset(self, seen) must accept the call reset(self, corridor, seen)",
            ),
            (
                "def V(x, v, *rest, gain):\n    return 0.0\n",
                "V(x, v, rest, gain) must accept the call V(seen)",
            ),
        ],
    )
    def test_is_refused_in_a_sentence(self, source, said, tmp_path, monkeypatch, command_line):
        monkeypatch.chdir(tmp_path)
        (tmp_path / "my.py").write_text(source)
        code, out, err = command_line("campaign", "--vut", "my.py:V", "--out", "run")
        assert (code, out, err) == (2, "", f"merge-sumo: {said}\n")
        assert not (tmp_path / "run").exists()

    @pytest.mark.parametrize(
        "source",
        [
            "def f(*arguments, **named): ...",
            "class f:\n    def act(self, *rest): ...\n    def reset(self, seen, seed=0): ...",
            "class f:\n    act = staticmethod(lambda seen: 0.0)",
            "class f:\n    reset = None\n    def act(self, seen): ...",
            "import functools\nclass f:\n    act = functools.partialmethod(lambda s, a, b: 0.0, 1)",
        ],
    )
    def test_is_none_where_the_call_fits(self, source):
        names: dict = {}
        exec(source, names)  # noqa: S102
        check = (
            check_methods
            if isinstance(names["f"], type)
            else partial(check_call, arguments=("seen",))
        )
        check(names["f"])


@pytest.mark.parametrize(
    "error",
    [
        ValueError("line\x1b[2J"),
        KeyError("x"),
        OSError(9, "no"),
        BrokenPipeError(32, ""),
    ],
    ids=lambda error: type(error).__name__,
)
def test_a_fault_of_ours_is_a_traceback_and_no_result(monkeypatch, command_line, error):
    def fails(**_):
        raise error

    monkeypatch.setattr(api, "vuts", fails)
    code, out, err = command_line("vuts")
    assert (code, out) == (cli.FAULT, "")
    assert err.startswith("Traceback (most recent call last):\n")
    assert f"{type(error).__name__}" in err
    assert err.endswith("this is a bug in merge-sumo, not a result: report it with these lines\n")
    assert "\x1b" not in err
