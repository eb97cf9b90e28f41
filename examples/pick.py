"""Pick a ball that the camera detected."""

import sys

from zencell import pose
from zencell.blocking import Cell

with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start("panda", speed=2) as cell:
    ball = cell.objects(least=1)[0]
    at = ball.pose.position
    cell.gripper.open()
    cell.arm.move(pose(at.x, at.y, at.z + 0.15))
    cell.arm.move(pose(at.x, at.y, at.z), straight=True, touch=[ball.id])
    held = cell.gripper.close(force=20.0)
    cell.arm.move(pose(at.x, at.y, at.z + 0.15), straight=True)
    print(f"{ball.id} is {held.outcome}, {held.width:.3f} m wide")
