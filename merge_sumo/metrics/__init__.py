"""Failure mode coverage, and the geometry of it."""
