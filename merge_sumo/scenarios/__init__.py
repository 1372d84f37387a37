"""Scenarios as files, what a road suggests, and how it looks."""
