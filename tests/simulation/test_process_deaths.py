"""Deaths of a controller's process: from outside, and by the controller itself."""

from __future__ import annotations

import json
import sys

import pytest
from support.campaigning import campaign_settings, run_campaign

from merge_sumo.campaigns.recorded import OUTCOMES, RAN_AGAIN, SETTINGS, RecordedCampaign
from merge_sumo.campaigns.settings import CampaignSettings
from merge_sumo.errors import UserError

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals of POSIX are needed")

CALM = "class Vut:\n    def act(self, seen):\n        return 0.5\n"
DIES = """
import os, pathlib, signal, sys
FLAGS = pathlib.Path(__file__).with_name("flags")
class Vut:
    def reset(self, seen):
        self.name = f"{{seen.x_pov_m}}"
        self.bad = seen.v_pov_mps > 33.0
    def act(self, seen):
        flags = list(FLAGS.glob(self.name + " *"))
        if self.bad and seen.t_s == 0.3 and len(flags) < {times}:
            (FLAGS / f"{{self.name}} {{len(flags)}}").touch()
            {how}
        return 0.5
"""
KILLED = "os.kill(os.getpid(), signal.SIGKILL)"


def settings(spec: str, **more: object) -> CampaignSettings:
    return campaign_settings(vut=spec, cases=12, batch=12, seed=1, sampler="uniform", **more)


def outcomes(run: RecordedCampaign) -> bytes:
    return (run.folder / OUTCOMES).read_bytes()


@pytest.fixture
def campaign(tmp_path):
    """Return a function that runs a campaign of a source."""
    (tmp_path / "flags").mkdir()

    def run(name: str, source: str, **more: object) -> RecordedCampaign:
        (tmp_path / f"{name}.py").write_text(source, encoding="utf-8")
        return run_campaign(settings(f"{tmp_path / name}.py:Vut", **more), tmp_path / name)

    return run


@pytest.fixture(scope="module")
def calm(tmp_path_factory) -> RecordedCampaign:
    """Return a campaign in which nothing dies."""
    folder = tmp_path_factory.mktemp("calm")
    (folder / "calm.py").write_text(CALM, encoding="utf-8")
    return run_campaign(settings(f"{folder / 'calm.py'}:Vut"), folder / "run")


class TestKills:
    @pytest.mark.slow
    @pytest.mark.parametrize("how", [KILLED, "os._exit(3)"])
    def test_that_come_once_leave_cases_as_they_are(self, campaign, calm, how):
        struck = campaign("struck", DIES.format(how=how, times=1))
        assert outcomes(struck) == outcomes(calm)
        assert calm.settings.ran_again == 0
        assert RAN_AGAIN not in calm.record
        bad = sum(outcome.case.v_pov0_mps > 33.0 for outcome in calm.outcomes)
        assert struck.settings.ran_again >= bad
        assert json.loads((struck.folder / SETTINGS).read_text())[RAN_AGAIN] >= bad
        assert "cases ran again after a process was killed" in struck.ran_again_in_words

    @pytest.mark.slow
    def test_while_a_vut_is_opened_do_not_end_the_campaign(self, campaign, calm):
        once = """
import os, pathlib, signal
flag = pathlib.Path(__file__).with_name("opened")
if not flag.exists():
    flag.touch()
    os.kill(os.getpid(), signal.SIGKILL)
"""
        assert outcomes(campaign("once", once + CALM)) == outcomes(calm)
        with pytest.raises(UserError, match=r"loading the VUT .* by signal 9 \(SIGKILL\)"):
            campaign("always", f"import os, signal\n{KILLED}\n{CALM}")
