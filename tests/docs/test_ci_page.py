"""The CI of a controller as the page shows it; `.ci/run` runs its commands as they stand."""

from __future__ import annotations

from ci_snippets import PAGE, main

import merge_sumo as ms

TEXT = PAGE.read_text(encoding="utf-8")


def test_the_cases_of_the_page_are_those_of_its_controller(tmp_path, monkeypatch):
    main("github", tmp_path / "ci")
    monkeypatch.chdir(tmp_path / "ci")
    same = ms.rerun("cases.toml", vut="controller.py:Controller")
    assert same.text == (tmp_path / "ci" / "cases.toml").read_text()
    controller = (tmp_path / "ci" / "controller.py").read_text().replace("+ 2.0", "+ 0.2")
    (tmp_path / "ci" / "controller.py").write_text(controller)
    now = ms.rerun("cases.toml", vut="controller.py:Controller")
    shown = TEXT.partition("in the place of `+ 2.0`")[2].partition("```text\n")[2]
    for line in shown.partition("```")[0].splitlines():
        assert line == "..." or line in now.lines()
