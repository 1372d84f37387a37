"""A road network read as data, and the merge that is found in it."""
