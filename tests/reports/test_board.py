"""The page for a board: each number is that of its source, and the page lets nothing in."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any

import pytest
from calling import assert_refused
from handmade import write_run
from test_report import EVIL, root_of

import merge_sumo as ms
from merge_sumo.campaigns.store import OUTCOMES, SETTINGS, Run, failures
from merge_sumo.reports.board import PAGE, RECORD, SCHEMA, write_board
from merge_sumo.reports.board_statements import BoardModel, Statement
from merge_sumo.studies.crosscheck import CROSSCHECK, Crosscheck, Motion, Verdicts
from merge_sumo.studies.stress import STRESS, Flips, Rung, Stress
from merge_sumo.system.records import to_plain


def stressed(run: Run) -> Stress:
    """Return three runs of 150 cases: one failure passes; 1 of 150, 1 of 300 verdicts flip."""
    failing = tuple(outcome.index for outcome in failures(run.outcomes[:150]))
    return Stress(
        cases=150,
        failures=failing,
        rungs=(
            Rung(name="lag-0.2", about="an actuator lag of .2 s", runs=(Flips(failing[:1]),)),
            Rung(name="noise", about="noise of the start", runs=(Flips(fails=(4,)), Flips())),
            Rung(name="twin", about="another engine", skipped="it needs SUMO"),
        ),
        seed=0,
        vut=run.vut,
    )


PEER = Crosscheck(
    peer="highway-env 1.10",
    motion=Motion(cases=12, steps=99, largest_m=3e-9, largest_mps=1e-10, worst_case=4),
    verdicts=Verdicts(
        recorded=12, fresh=30, failures=5, largest_m=0.0, other_motion=0, differences=()
    ),
    why_no_verdicts="",
    measured=None,
    vut="handmade",
    seed=0,
)


def leave(folder: Path, name: str, value: Any) -> None:
    (folder / name).write_text(json.dumps(to_plain(value)))


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> Run:
    run = write_run(tmp_path_factory.mktemp("made") / "run")
    leave(run.folder, STRESS, stressed(run))
    leave(run.folder, CROSSCHECK, PEER)
    return run


@pytest.fixture(scope="module")
def record(made) -> dict[str, Any]:
    write_board(made)
    known: dict[str, Any] = json.loads((made.folder / RECORD).read_text())
    return known


def sentences(run: Run, topic: str) -> list[Statement]:
    by_name = {t.name: t for t in BoardModel(run).topics()}
    return list(by_name[topic].statements)


def at(content: Any, key: str) -> Any:
    """Return what a file has at a key; the length of a list."""
    for part in key.split("."):
        content = content[part]
    return len(content) if isinstance(content, list) and isinstance(content[0], int) else content


def checked_figures(run: Run, names: list[str]) -> int:
    """Check figures from JSON files whose key is a path; return how many there are."""
    files = {name: json.loads((run.folder / name).read_text()) for name in names}
    plain = 0
    for topic in BoardModel(run).topics():
        for figure in (f for said in topic.statements for f in said.figures):
            content = files.get(figure.file)
            if content is None or " " in figure.key or figure.key.startswith("rungs"):
                continue
            found = at(content, figure.key)
            plain += 1
            assert figure.value == found or figure.value in found, figure
    return plain


class TestNumbers:
    def test_are_those_of_the_outcomes(self, made):
        lines = [json.loads(line) for line in (made.folder / OUTCOMES).read_text().splitlines()]
        failing = [o for o in lines if o["score"] is not None and o["score"] < -500]
        touching = [o for o in failing if o["severity"] == "contact"]
        passing = [o for o in lines if o not in failing and o["severity"] == "contact"]
        first, *others, second = sentences(made, "found")[: 2 + bool(passing)]
        levels = sentences(made, "found")[2 + bool(passing) :]
        assert [other.figures[0].value for other in others] == [len(passing)] * bool(passing)
        assert first.text.startswith(
            f"{len(failing)} of 180 cases fail; in {len(touching)} of them bodies touch"
        )
        assert [f.value for f in first.figures] == [len(failing), 180, len(touching)]
        assert second.text.startswith("1 cases ended in an error and 0 by the timeout")
        at_1 = [o for o in failing if o["level"] == 1]
        assert levels[1].text.startswith(f"Level 1: {len(at_1)} of 60 cases fail")
        worst = min(failing, key=lambda o: o["score"])
        assert levels[-1].figures[0].value == worst["index"]
        measure = "dx_m" if worst["impact_speed_mps"] is None else "impact_speed_mps"
        assert levels[-1].figures[1].value == abs(worst[measure])
        assert levels[-1].figures[1].key == f"line {worst['index']}: {measure}"

    def test_of_files_are_what_the_file_has_at_the_key(self, made):
        assert checked_figures(made, [STRESS, CROSSCHECK]) >= 5

    def test_of_a_stress_test(self, made):
        first, narrow, flips, skipped = (s.text for s in sentences(made, "robust"))
        all_of = len(stressed(made).failures)
        assert first == (
            f"{all_of - 1} of {all_of} failures remain failures in all 3 runs of the stress test, "
            "each with one thing changed."
        )
        assert narrow.startswith("A narrow region of failures has few that remain")
        assert flips == (
            "Share of verdicts that flip: 0.67 % (an actuator lag of .2 s); 0.33 % (noise of the "
            "start)."
        )
        assert skipped == "Not run: another engine (it needs SUMO)."

    def test_of_another_simulator(self, made):
        verdicts, motion, _ = (s.text for s in sentences(made, "simulators"))
        assert verdicts == (
            "In another simulator, highway-env 1.10, with the same drivers, criterion and "
            "equations of motion, 42 of 42 cases end as in SUMO; 5 of them fail in SUMO."
        )
        assert motion.endswith("differs from that of highway-env 1.10 by 3e-09 m at most.")

    def test_name_the_hashes_of_their_files(self, made, record):
        assert record["schema"] == SCHEMA
        assert set(record["files"]) == {SETTINGS, OUTCOMES, STRESS, CROSSCHECK}
        for name, sha256 in record["files"].items():
            assert sha256 == hashlib.sha256((made.folder / name).read_bytes()).hexdigest()


class TestThePage:
    def test_has_each_sentence_of_the_json_with_its_sources(self, made, record):
        root = root_of((made.folder / PAGE).read_text())
        for topic in record["topics"]:
            (section,) = root.xpath(f"//section[@id='{topic['name']}']")
            said = [" ".join(li.text_content().split()) for li in section.xpath(".//li")]
            assert len(said) == len(topic["statements"]) > 0
            for text, statement in zip(said, topic["statements"], strict=True):
                assert text.startswith(statement["text"])
                assert all(f"{f['file']}: " in text for f in statement["figures"])
                assert all(f["shown"] in statement["text"] for f in statement["figures"])

    def test_loads_nothing_and_runs_nothing(self, made, record):
        page = (made.folder / PAGE).read_text()
        root = root_of(page)
        assert root.xpath("//script | //@href | //@src | //@style | //img") == []
        (policy,) = root.xpath("//meta[@http-equiv='Content-Security-Policy']/@content")
        (style,) = root.xpath("//style")
        digest = base64.b64encode(hashlib.sha256(style.text.encode()).digest()).decode()
        assert policy == f"default-src 'none'; style-src 'sha256-{digest}'"

    def test_shows_what_comes_from_outside_as_text(self, tmp_path):
        run = write_run(tmp_path / "run", vut=EVIL + "{}", sampler=EVIL + "{0}", per_level=4)
        leave(run.folder, CROSSCHECK, {**to_plain(PEER), "peer": EVIL + "{1}", "vut": run.vut})
        html_file, _ = write_board(run)
        root = root_of(html_file.read_text())
        assert root.xpath("//script | //img") == []
        assert root.xpath("//h1")[0].text == EVIL + "{}"

    def test_is_the_same_when_written_again(self, made, record):
        before = [(made.folder / name).read_bytes() for name in (PAGE, RECORD)]
        write_board(Run(made.folder))
        assert [(made.folder / name).read_bytes() for name in (PAGE, RECORD)] == before


class TestWhatWasNotRun:
    def test_is_said_with_its_command(self, tmp_path):
        folder = tmp_path / "a run"
        run = write_run(folder, per_level=10)
        commands = [s.command for t in BoardModel(run).topics() for s in t.statements if s.command]
        for verb in ("failures-per-merge", "stress", "crosscheck", "replay"):
            assert any(c.startswith(f"merge-sumo {verb} '{folder}'") for c in commands), verb

    def test_nor_found_is_said_as_such(self, tmp_path):
        quiet = write_run(tmp_path / "quiet", per_level=4, levels=(0,), errors={2: "a", 3: "a"})
        assert sentences(quiet, "found")[0].text == "None of 2 tested cases fails."
        lost = write_run(tmp_path / "lost", per_level=2, levels=(0,), errors={0: "a", 1: "b"})
        assert sentences(lost, "found")[0].text == "Nothing was tested: 2 cases ran."


class TestFiles:
    @pytest.mark.parametrize("name", [STRESS, CROSSCHECK, "failures-per-merge.json"])
    @pytest.mark.parametrize("content", ["{", "[]", '{"peer": 1}'])
    def test_that_are_not_as_they_were_written_are_refused(self, call, tmp_path, name, content):
        run = write_run(tmp_path / "run", per_level=4)
        (run.folder / name).write_text(content)
        assert_refused(call("board", run.folder), "is not as it was written")
        assert not (run.folder / PAGE).exists()

    @pytest.mark.parametrize("name", [PAGE, RECORD])
    def test_of_another_are_not_replaced(self, call, tmp_path, name):
        run = write_run(tmp_path / "run", per_level=4)
        (run.folder / name).write_text("mine")
        assert_refused(call("board", run.folder), "is not replaced: move it away")
        assert (run.folder / name).read_text() == "mine"

    @pytest.mark.parametrize(
        ("name", "of_another"),
        [
            (STRESS, {"vut": "another"}),
            (STRESS, {"cases": 181}),
            (STRESS, {"failures": [0]}),
            (CROSSCHECK, {"vut": "another"}),
        ],
    )
    def test_of_another_campaign_are_refused(self, call, tmp_path, name, of_another):
        run = write_run(tmp_path / "run")
        known = stressed(run) if name == STRESS else PEER
        leave(run.folder, name, {**to_plain(known), **of_another})
        assert_refused(call("board", run.folder), f"{name} is of another campaign, or of cases")
        assert not (run.folder / PAGE).exists()

    @pytest.mark.parametrize("verb", ["board", "report"])
    def test_of_outcomes_with_a_torn_last_line_are_said_to_be_of_fewer(self, call, tmp_path, verb):
        run = write_run(tmp_path / "run", per_level=4)
        path = run.folder / OUTCOMES
        path.write_bytes(path.read_bytes()[:-120])
        code, _, said = call(verb, run.folder)
        assert (code, said.count("\n")) == (0, 1)
        assert "was interrupted" in said
        assert "the last line of outcomes.jsonl is torn" in said
        if verb == "board":
            assert said.strip() == json.loads((run.folder / RECORD).read_text())["interruption"]
            assert said.strip() in (run.folder / PAGE).read_text()

    def test_of_no_campaign_are_none_to_show(self, call, tmp_path):
        assert_refused(
            call("board", tmp_path), "is not a campaign", "name a folder that `merge-sumo campaign`"
        )


class TestOfACampaign:
    """A campaign in SUMO, and what studies leave in its folder."""

    @pytest.fixture(scope="class")
    @classmethod
    def run(cls, tmp_path_factory) -> Run:
        folder = tmp_path_factory.mktemp("runs") / "design1"
        setup: dict[str, Any] = {"level": 0, "seed": 1, "progress": False}
        found = ms.campaign("design1", cases=60, out=folder, **setup)
        ms.failures_per_merge(folder, "exid-5", cases=200, engine="kinematic", progress=False)
        ms.probability(folder, cases=200, engine="kinematic", progress=False)
        return found.run

    def test_its_numbers_are_what_the_files_have_at_the_keys(self, run):
        names = [SETTINGS, "failures-per-merge.json", "probability.json"]
        assert checked_figures(run, names) >= 25

    def test_failures_per_merge_and_their_probability_are_those_of_their_files(self, run):
        known = json.loads((run.folder / "failures-per-merge.json").read_text())
        first, level, _ = sentences(run, "often")
        assert [f.value for f in first.figures] == [
            *("exid-5", 8.7, known["low"], known["high"], 0.95, known["high"]),
            known["outside"][1],
        ]
        in_1000 = float(f"{1000.0 * known['high']:.2g}")
        assert f"at most {in_1000:g} of 1,000 merges" in first.text
        assert [f.value for f in level.figures] == [
            known["levels"]["0"]["low"],
            known["levels"]["0"]["high"],
        ]
        known = json.loads((run.folder / "probability.json").read_text())
        (chance,) = (s for s in sentences(run, "remains") if "probability" in s.text)
        assert [f.value for f in chance.figures[:3]] == [
            known[name] for name in ("probability", "low", "high")
        ]
        assert "if all starts and levels were alike" in chance.text

    def test_a_study_of_another_campaign_is_refused(self, run, tmp_path):
        other = write_run(tmp_path / "other", per_level=4)
        for name in ("failures-per-merge.json", "probability.json"):
            (other.folder / name).write_bytes((run.folder / name).read_bytes())
            with pytest.raises(ms.UserError, match=f"{name} is of another campaign: its vut"):
                write_board(other)
            (other.folder / name).unlink()
