"""Vehicles under test: the controllers of users, and the way in which they are called."""
