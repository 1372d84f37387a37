"""Reads scenarios with commonroad-io, in an environment that has it: COMMONROAD_PYTHON FILE..."""

import os
import sys
from pathlib import Path

from commonroad.common.file_reader import CommonRoadFileReader
from lxml import etree

schema = etree.XMLSchema(etree.parse(os.environ["COMMONROAD_SCHEMA"]))
for name in sys.argv[1:]:
    tree = etree.parse(name)
    schema.assertValid(tree)
    scenario, problems = CommonRoadFileReader(name).open(lanelet_assignment=True)
    root = tree.getroot()
    cars = root.findall("dynamicObstacle")
    assert len(scenario.dynamic_obstacles) == len(cars)
    assert len(scenario.lanelet_network.lanelets) == len(root.findall("lanelet"))
    assert len(problems.planning_problem_dict) == 1
    for car in scenario.dynamic_obstacles:
        assert car.initial_center_lanelet_ids, "each car starts on a lane"
        written = [int(one.text or 0) for one in root.iterfind(".//trajectory/state/time/exact")]
        assert car.prediction.final_time_step == max(written)
    print(f"{Path(name).name}: valid, and read back")  # noqa: T201
