"""Fingers that wait for the arm: who moves it knows when it arrives, and whether it does, as nobody else does."""

from __future__ import annotations

import math

import numpy as np

from common.control.controller import TrajectoryController
from common.control.jogging import ToolKinematics
from common.hardware.interface import Vector
from common.messages import GripperCommand

LATER = 0.05  # [s] by which an arm may arrive later than it was to when the fingers began to close


class WaitingFingers:
    """One command that waits for a goal of the arm; then, if it closes them, whether the arm arrives in time."""

    def __init__(self, arm: TrajectoryController, kinematics: ToolKinematics | None) -> None:
        """Wait for this arm; without kinematics, until it is there."""
        self._arm, self._kinematics = arm, kinematics
        self.command: GripperCommand | None = None
        self._end: Vector | None = None  # where the tool is at the end of the goal, (3,) in world [m]
        self._closing = ""  # goal that the fingers began to close for
        self._due = math.inf  # cell time at which the arm is to be there [s]

    def wait(self, command: GripperCommand) -> None:
        """Have fingers wait for the goal that is followed."""
        self.command = command
        self._end = self._place(self._arm.end) if self._arm.end is not None else None

    def drop(self) -> GripperCommand | None:
        """Have nothing wait any longer: what did."""
        command, self.command = self.command, None
        return command

    def begins(self, now: float, measured: Vector, width: float) -> bool:
        """Whether those that wait are to begin at a time [s]: they do.

        The arm is measured there (dof,) [rad], the fingers are so far apart [m].
        """
        command = self.command
        if command is None:
            return False
        left, there = self._arm.arrives_in(command.after), self._arm.succeeded(command.after)
        if not there and (left > command.lead or not self._is_near(measured, command.within)):
            return False
        self.command = None
        if command.width < width and not there:
            self._closing, self._due = command.after, now + left
        return True

    def called_off(self) -> tuple[GripperCommand, str] | None:
        """Those that need not wait any longer, as the arm does not arrive, and why."""
        command = self.command
        if command is None or not self._arm.fails(command.after):
            return None
        self.command = None
        return command, f"goal {command.after!r} of the arm ends before it is there"

    def closed_before(self, now: float) -> bool:
        """Whether fingers began to close for an arm that is not going to arrive in time; said once."""
        if not self._closing:
            return False
        if self._arm.fails(self._closing):  # it comes to rest already, for a reason of its own
            self._closing = ""
            return False
        left = self._arm.arrives_in(self._closing)
        late = now + left > self._due + LATER
        if left == 0.0 or late:
            self._closing = ""
        return late and left > 0.0

    def _place(self, q: Vector) -> Vector | None:
        return None if self._kinematics is None else np.array(self._kinematics.fk(q)[:3, 3])

    def _is_near(self, q: Vector, within: float) -> bool:
        place = self._place(q)
        return place is not None and self._end is not None and float(np.linalg.norm(place - self._end)) <= within
