"""Parameters at runtime: from which minimum area the detector loses the balls."""

import sys

from zencell import NothingReceived, UnknownName
from zencell.blocking import Cell

AREA = "vision_detector.min_contour_area_px"

with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start("panda", overrides=["world.count=3"]) as cell:
    cell.objects(least=3)
    before = cell.param[AREA]
    for area in (before, 2 * before, 16 * before):
        cell.param[AREA] = area
        detections = cell.listen("detected_objects")
        next(detections)
        print(f"{area:g} px: {len(next(detections).markers)} seen")
    cell.param.update({AREA: before, "trajectory_executor.speed_scaling": 0.5})  # all of them or none
    try:
        print(cell.param["vision_detector.min_area"])
    except UnknownName as error:
        print(error)
    try:
        cell.objects(least=30, timeout=0.5)
    except NothingReceived as error:
        print(error)
