"""Named poses, poses, straight lines, arcs and paths; a plan inspected before execution."""

import sys

from zencell import MotionFailed, any_of, pose, region, through
from zencell.blocking import Cell

with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start("panda", speed=2) as cell:
    arm = cell.arm
    print("joints", ", ".join(arm.description().joints))
    arm.move("home")
    arm.move(pose(0.45, 0.1, 0.4))  # metres in world; the tool looks straight down unless rpy says otherwise
    arm.move(pose(0.45, -0.1, 0.4), straight=True)
    arm.move(pose(0.45, 0.1, 0.4), via=(0.5, 0.0, 0.4))
    arm.move(through(pose(0.5, 0.1, 0.4), pose(0.5, -0.1, 0.4), pose(0.4, -0.1, 0.4), tool_speed=0.1))
    arm.move(region(pose(0.45, 0.0, 0.4), size=(0.05, 0.05, 0.0), yaw=3.0))

    plan = arm.plan(any_of("home", pose(0.4, 0.0, 0.5)), speed=0.5)
    print(f"{plan.planner} planned {plan.duration:.2f} s in {1e3 * plan.seconds:.0f} ms, {len(plan.times)} points")
    arm.execute(plan)

    try:
        arm.move(pose(3.0, 0.0, 0.4))
    except MotionFailed as error:
        print(f"{error.code}: {error}")
    x, y, z = arm.pose()[:3, 3]
    print(f"the tool is at {x:.3f}, {y:.3f}, {z:.3f} m")
