"""A road with its cars, a case to play on it, and what happened."""
