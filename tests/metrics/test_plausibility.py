"""What is odd about the outcomes of a campaign: clipped steps, and errors after M."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

from merge_sumo.metrics.measures import Measures
from merge_sumo.metrics.plausibility import doubts
from merge_sumo.scenario.scenario import DT_S


class TestDoubts:
    def test_clipped_accelerations_are_reported(self, run):
        rows = [round(o.measures.t_end_s / DT_S) for o in run.outcomes]
        at_limit = []
        for outcome, steps in zip(run.outcomes, rows, strict=True):
            values = outcome.measures.values | {"clipped_steps": int(0.25 * steps)}
            at_limit.append(replace(outcome, measures=Measures(**values)))
        clipped = sum(o.measures.clipped_steps for o in at_limit)
        (note,) = doubts(at_limit, {})
        assert f"in {clipped} of {sum(rows)} steps the VUT commanded more" in note
        assert doubts(run.outcomes, {}) == []

    def test_errors_after_m_are_reported(self, run):
        first, second, *others = run.outcomes
        wrong = []
        for outcome in (first, second):
            measures = Measures(**outcome.measures.values | {"error": "answered nan"})
            wrong.append(replace(outcome, measures=measures))
        assert doubts([*wrong, *others], {}) == [
            f"in 2 cases an error ends the follow-up, the first in case {first.index}: answered nan"
        ]

    def test_the_command_says_it_in_json_and_report(self, tmp_path, command_line, monkeypatch):
        monkeypatch.chdir(tmp_path)
        Path("hard.py").write_text("def f(seen):\n    return 9.0\n")
        options = ("--level", 0, "--cases", 6, "--sampler", "uniform", "--out", "run", "--json")
        code, out, err = command_line("campaign", "--vut", "hard.py:f", *options)
        assert code == 0, err
        (note,) = json.loads(out)["notes"]
        assert note.startswith("accelerations were clipped: in ")
        assert "the limits, -4 to 2 m/s2" in note
        assert note[1:] in Path("run/report.html").read_text()
