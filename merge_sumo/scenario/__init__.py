"""A scenario, a case, and the motion in its episode.

`road.scenario_file` reads and writes scenarios, `campaigns.scenario_suggestion` suggests one for a
road, and `road.loader.road_for` finds the road of one.
"""
