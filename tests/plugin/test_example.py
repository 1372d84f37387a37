"""The example package keeps the contracts; so may the tests of any other."""

from __future__ import annotations

import pytest
from merge_sumo_example import MiddleSampler, closest_m

from merge_sumo.controllers.kinds import KINDS
from merge_sumo.testing import MeasureContract, SamplerContract, VutContract

installed = pytest.mark.skipif(
    "constant" not in KINDS, reason="the example package is not installed"
)


class TestMiddleSampler(SamplerContract):
    sampler = MiddleSampler


class TestClosest(MeasureContract):
    measure = closest_m


@installed
class TestConstant(VutContract):
    vut = "constant:0.5"
