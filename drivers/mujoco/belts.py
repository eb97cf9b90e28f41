"""Conveyor belts in physics: bodies that move at the speed of the belt, and are put back before each step.

Contact friction acts by the velocity of the surface, which is that of a slide joint. Its position is reset before each
step, so that the solid stays where it is, and its velocity is set again, so that nothing slows it.
"""

from __future__ import annotations

import math

import mujoco
import numpy as np

from common.config import World
from common.sim.bodies import Body
from common.sim.conveyors import Belts, carried
from drivers.mujoco.model import CellModel


class PhysicsBelts:
    """Drives the belts of a compiled model."""

    def __init__(self, world: World, cell: CellModel, belts: Belts) -> None:
        """Drive these belts."""
        self._world, self._cell, self._belts = world, cell, belts
        self._addresses = [(belt, cell.joints[f"belt:{name}"], cell.dofs[f"belt:{name}"])
                           for name, belt in belts.by_name.items()]

    def drive(self, data: mujoco.MjData, now: float) -> None:
        """Set position and velocity of all belts for the step to a time [s]."""
        self._belts.advance(now)
        for belt, qpos, dof in self._addresses:
            data.qpos[qpos], data.qvel[dof] = 0.0, belt.speed

    def update(self, data: mujoco.MjData, bodies: dict[str, Body]) -> None:
        """Update light barriers, and let objects at the end of a belt that circulates come again at its start."""
        if not self._belts:
            return
        self._belts.update_barriers(bodies.values())
        for name, (belt, _) in carried(self._belts, dict.fromkeys(self._belts.by_name, 0.0), bodies.values()).items():
            config, reach = belt.config, bodies[name].solid.reach
            way, length = config.along(*bodies[name].T[:2, 3].tolist())[0], config.dimensions[0]
            if config.end == "wrap" and (way > length - reach if belt.speed > 0 else way < reach):
                at, shift = self._cell.objects[name], math.copysign(length - 2 * reach, belt.speed)
                data.qpos[at.qpos: at.qpos + 2] -= shift * np.array(config.direction)
