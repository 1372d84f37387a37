"""What tests of others call: assertions on a controller, for pytest or any other runner."""

from merge_sumo.testing.assertions import assert_no_failures

__all__ = ["assert_no_failures"]
