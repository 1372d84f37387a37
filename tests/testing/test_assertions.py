"""`merge_sumo.testing`: what a test of a controller gets told."""

from __future__ import annotations

import pytest

from merge_sumo.testing import assert_no_failures


def test_a_controller_that_fails_nowhere_passes(tmp_path):
    run = assert_no_failures("fsm", level=0, cases=20, seed=1, out=tmp_path / "run")
    assert len(run.cases) == 20
    assert run.failures == []


@pytest.fixture(scope="module")
def told(tmp_path_factory) -> tuple[str, str]:
    """Return the message on a controller that fails, and the folder of its campaign."""
    folder = tmp_path_factory.mktemp("failing") / "run"
    with pytest.raises(AssertionError) as raised:
        assert_no_failures("level0", level=0, cases=20, seed=1, out=folder, fail_when="contact")
    return str(raised.value), str(folder)


class TestOneThatFails:
    def test_is_told_what_failed_and_where_the_report_is(self, told):
        message, folder = told
        first, criterion, *_ = message.splitlines()
        assert first.startswith("level0: ")
        assert "failures" in first
        assert "seed 1" in first
        assert "clearance_m" in criterion
        assert f"report: {folder}/report.html" in message

    def test_is_told_how_to_run_the_worst_case_again(self, told, command_line):
        message, _ = told
        command = message.split("run it again: merge-sumo ")[1].splitlines()[0]
        code, out, _ = command_line(*command.split())
        assert code == 1
        assert "contact" in out


def test_an_error_of_the_controller_is_no_pass(tmp_path):
    def errs(seen):
        raise ZeroDivisionError("by zero")

    with (
        pytest.warns(UserWarning, match="errs"),
        pytest.raises(AssertionError, match="first error: case 0") as raised,
    ):
        assert_no_failures(errs, level=0, cases=4, seed=1, out=tmp_path / "run")
    assert "by zero" in str(raised.value)
