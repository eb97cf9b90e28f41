"""Where the arm is in the numbers that persons read: degrees, and mm."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from common import topics
from common.robot.transforms import matrix_to_rpy
from page.feeds import Latest
from page.jog import AXES

if TYPE_CHECKING:
    from common.robot.model import RobotModel

Numbers = tuple[float, float, float]
Array = NDArray[np.float64]


class ArmNumbers:
    """Joints in degrees (in mm where they slide), the tool in mm and degrees.

    Attributes:
        scales: (dof,) what joint positions [rad, m] are multiplied by.
        units: of the joints.
    """

    def __init__(self, robot: RobotModel, latest: Latest) -> None:
        """Tell of a robot, which no other thread uses, by its newest joint states."""
        self._robot, self._latest = robot, latest
        slides = [joint.shortname().startswith("JointModelP") for joint in robot.model.joints[1:]]
        self.scales: Array = np.where(slides, 1e3, 180 / math.pi)
        self.units = ["[mm]" if each else "[°]" for each in slides]

    def joints(self) -> Array | None:
        """Where the joints are (dof,) [rad, m], if that is known."""
        state = self._latest(topics.JOINT_STATES)
        return self._robot.order(state.name, state.position) if state is not None else None

    def of(self, q: Array) -> tuple[Numbers, Numbers, list[float]]:
        """Position [mm] and roll, pitch, yaw [degrees] of the tool in world, and the joints, all rounded; q (dof,)."""
        T_world_tcp = self._robot.fk(q)
        x, y, z = (round(1e3 * float(value), 1) for value in T_world_tcp[:3, 3])
        roll, pitch, yaw = (round(math.degrees(value), 1) for value in matrix_to_rpy(T_world_tcp[:3, :3]))
        return (x, y, z), (roll, pitch, yaw), [round(float(value), 2) for value in q * self.scales]

    def live(self) -> dict[str, str]:
        """The numbers now, by the names that the panels have for them; empty while they are not known."""
        q = self.joints()
        if q is None:
            return {}
        xyz, rpy, joints = self.of(q)
        shown = {f"j:{name}": f"{value:.1f} {unit.strip('[]')}"
                 for name, value, unit in zip(self._robot.joint_names, joints, self.units, strict=True)}
        shown |= {f"p:{axis}": f"{value:.1f} mm" for axis, value in zip(AXES, xyz, strict=True)}
        return shown | {f"r:{axis}": f"{value:.1f} °" for axis, value in zip(AXES, rpy, strict=True)}
