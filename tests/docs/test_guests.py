"""The guests of the benchmark, `tools/guests/`, keep the contract of samplers."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from merge_sumo.studies.entrants import sampler_class
from merge_sumo.testing import SamplerContract
from merge_sumo.values.case import Pool
from merge_sumo.values.scenario import US23

GUESTS = Path(__file__).parents[2] / "tools" / "guests"


def needs(library):
    return pytest.mark.skipif(find_spec(library) is None, reason=f"{library} is not installed")


class TestSobol(SamplerContract):
    sampler = sampler_class(f"{GUESTS / 'sobol.py'}:SobolSampler")

    def test_fills_the_square_evenly(self):
        """64 points of a (0, m, 2)-net: one in each cell of 8 x 8."""
        pool = Pool(levels=(0,), scenario=US23)
        cases = self.sampler(pool, 3).ask(64)
        x_m, v_mps = pool.scenario.dimensions(0)
        cells = {
            (
                int(8 * (case.x_pov0_m - x_m.low) / (x_m.high - x_m.low)),
                int(8 * (case.v_pov0_mps - v_mps.low) / (v_mps.high - v_mps.low)),
            )
            for case in cases
        }
        assert len(cells) == 64


@needs("openturns")
class TestAkMcs(SamplerContract):
    sampler = sampler_class(f"{GUESTS / 'ak_mcs.py'}:AkMcsSampler")


@needs("ribs")
class TestCmaMe(SamplerContract):
    sampler = sampler_class(f"{GUESTS / 'cma_me.py'}:CmaMeSampler")


@needs("botorch")
class TestStraddle(SamplerContract):
    sampler = sampler_class(f"{GUESTS / 'straddle.py'}:StraddleSampler")
