"""Grip and lift parts that no detector knows, at places that the program knows."""
from pathlib import Path

from zencell import pose
from zencell.blocking import Cell

GRIPS = {"hammer": (0.47, -0.16, 0.4), "ring": (0.5, 0.1, 0.0), "ell": (0.65, -0.005, 0.0)}  # x, y [m], yaw [rad]
with Cell.start(str(Path(__file__).with_name("odd.yaml"))) as cell:
    for name, (x, y, yaw) in GRIPS.items():
        above, grip = (pose(x, y, z, rpy=(3.14159, 0.0, yaw)) for z in (0.25, 0.012))
        cell.gripper.open()
        cell.arm.move(above)
        cell.arm.move(grip, straight=True)
        held = cell.gripper.close(force=20)
        cell.arm.move(above, straight=True)
        up = next(part for part in cell.world.objects() if part.id == name).pose.position.z
        print(f"{name}: {held.outcome}, {1e3 * held.width:.1f} mm wide, lifted to {up:.3f} m")
