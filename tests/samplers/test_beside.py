"""A copy of `coverage` in a second process: the same proposals, also where that process dies."""

from __future__ import annotations

import multiprocessing

from campaigning import campaign_settings, run_campaign

from merge_sumo.samplers.beside import CopyBeside
from merge_sumo.system.workers import InProcess, Workers


def test_a_second_process_and_its_death_change_no_byte(tmp_path, monkeypatch):
    answer, answered = CopyBeside.answer, []

    def noted(beside):
        beside._there.exception()  # waits until the process is there
        found = answer(beside)
        answered.append(found is not None)
        return found

    monkeypatch.setattr(CopyBeside, "answer", noted)
    settings = campaign_settings(vut="design2", levels=(0, 1, 2), cases=75, seed=3)
    seen = []

    def kill() -> None:
        beside = multiprocessing.active_children()
        seen.append(len(beside))
        if len(seen) == 3:
            for process in beside:
                process.kill()

    run_campaign(settings, tmp_path / "alone")
    run_campaign(settings, tmp_path / "two", workers=Workers(InProcess, 2))
    assert answered[-1], "the copy searched"
    run_campaign(settings, tmp_path / "killed", workers=Workers(InProcess, 2), check=kill)
    assert not answered[-1], "this process searched alone"
    assert seen[:3] == [1, 1, 1]
    assert seen[-1] == 0
    assert not multiprocessing.active_children()
    texts = {
        (tmp_path / name / "outcomes.jsonl").read_bytes() for name in ("alone", "two", "killed")
    }
    assert len(texts) == 1
