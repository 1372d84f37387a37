"""Vehicles under test: what a user brings, and how it is called."""
