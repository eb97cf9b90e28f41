"""Motion authority, jogging, stop and hold."""

import sys

from zencell import JogFailed, MotionFailed
from zencell.blocking import Cell

with Cell(sys.argv[1]) if sys.argv[1:] else Cell.start("panda") as cell:
    arm = cell.arm
    with arm.owned(lease=30.0) as owner:  # no task and no other client moves it meanwhile
        print(f"the motion is {owner.description}")
        for axis in ((0.0, 0.0, -0.1), (0.0, 0.0, 0.1)):
            arm.jog(linear=axis, seconds=0.5)  # [m/s] in the base; at standstill 0.2 s later
        arm.jog(angular=(0.0, 0.0, 0.3), frame="tool", seconds=0.5)
        arm.jog(joints={arm.description().joints[0]: 0.2}, seconds=0.5)
    arm.stop("lunch")
    print("stopped:", arm.status().stopped)
    arm.move("home")  # the client that stopped it may move it, others may not
    arm.hold("an operator enters")
    try:
        arm.jog(linear=(0.1, 0.0, 0.0), seconds=0.5)
    except (MotionFailed, JogFailed) as error:
        print(error)
    arm.release()
