"""What tests of others use: assertions on a controller, and contracts of what extends the tool."""

from merge_sumo.testing.assertions import assert_no_failures
from merge_sumo.testing.contracts import MeasureContract, SamplerContract, VutContract

__all__ = ["MeasureContract", "SamplerContract", "VutContract", "assert_no_failures"]
