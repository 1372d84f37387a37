"""Drivers of cars, as arrays: level-k drivers and rule-based controllers."""
