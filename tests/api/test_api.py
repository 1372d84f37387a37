"""merge-sumo from Python."""

from __future__ import annotations

import pytest
from lxml import html
from support.handmade import write_run

import merge_sumo as ms
from merge_sumo.errors import UserError
from merge_sumo.files import DATED, dated


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    return write_run(tmp_path_factory.mktemp("api") / "run", vut="<b>x</b>")


@pytest.fixture
def opened(made) -> ms.CampaignRun:
    return ms.open_run(made.folder)


class TestARun:
    def test_shows_its_lines_and_names_as_text(self, opened):
        root = html.fragment_fromstring(opened._repr_html_(), create_parent="div")
        assert root.xpath(".//pre")[0].text.startswith("<b>x</b> on us23")
        assert root.xpath(".//b") == []


class TestACampaign:
    def test_is_the_one_of_the_command_line(self, tmp_path, run):
        seen: list = []
        again = ms.campaign(
            "design1", level=0, cases=60, batch=20, seed=1, out=tmp_path / "r", on_case=seen.append
        )
        assert len(seen) == 60
        first, second = (folder / "outcomes.jsonl" for folder in (run.folder, again.folder))
        assert first.read_bytes() == second.read_bytes()
        assert (again.folder / "report.html").is_file()


def test_a_name_that_is_not_there_is_an_attribute_error():
    with pytest.raises(AttributeError, match="nothing_like_it"):
        getattr(ms, "nothing_like" + "_it")


@pytest.mark.parametrize(
    ("verb", "values", "sentence"),
    [
        ("campaign", {"seed": 1.5}, "seed is 1.5: it must be a whole number"),
        ("campaign", {"cases": 0}, "`cases`"),
        ("campaign", {"vut": None}, "no VUT is named"),
        ("campaign", {"workers": "2"}, "`workers` is '2': give a number of processes"),
        ("campaign", {"workers": 0}, "`workers` is 0: it must be a whole number, 1 or more"),
        ("run", {"x_pov0_m": "a", "v_pov0_mps": 30.0}, "x_pov0_m is 'a': it must be a number"),
        ("truth", {"level": 0, "seed": -1}, "it must be a whole number"),
        ("compare", {}, "give several campaigns in a list"),
    ],
)
def test_a_wrong_value_is_one_sentence_and_leaves_nothing(
    verb, values, sentence, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UserError) as refused:
        getattr(ms, verb)(values.pop("vut", "design2"), **values)
    (line,) = refused.value._render_traceback_()  # as a notebook shows it
    assert sentence in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("verb", "keyword", "sentence"),
    [
        ("probability", "level", "`level`, which campaign, resume, run, rerun, truth"),
        ("campaign", "casse", "campaign has no keyword `casse`: did you mean "),
        ("open_run", "xyz", "`xyz`: choose one of folder"),
    ],
)
def test_a_keyword_of_another_function_is_refused_with_who_has_it(verb, keyword, sentence):
    with pytest.raises(UserError) as refused:
        getattr(ms, verb)("run", **{keyword: 1})
    assert sentence in str(refused.value)


def test_two_campaigns_of_a_second_have_folders_of_their_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for _ in range(3):
        path = dated("design1")
        assert DATED.fullmatch(path.name)
        path.mkdir(parents=True)
