"""For tests of users: assertions on a controller, and contracts of extensions."""

from merge_sumo.testing.assertions import assert_no_failures
from merge_sumo.testing.contracts import MeasureContract, SamplerContract, VutContract

__all__ = ["MeasureContract", "SamplerContract", "VutContract", "assert_no_failures"]
