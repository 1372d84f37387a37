"""A road with its cars, a case, and the motion in its episode."""
