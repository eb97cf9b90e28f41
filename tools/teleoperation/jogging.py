"""Jog commands by a device, with the rules of the operator's page: see `common/control/jogging.py`.

Commands are sent while the device requests a motion, 50 a second. When they cease, because the operator releases it,
the device is gone or this program hangs, the executor brakes 0.1 s after the last one.
"""

from __future__ import annotations

from typing import Any

from common import topics
from common.client.cell import Cell
from common.client.operator_motion import UNREACHABLE
from common.control.jogging import ENDED, PAUSE, TOOL_SPEED
from common.messages import JogCommand, MotionOwner, MotionStatus, Vector3
from common.messages.execution import JogFrame
from tools.teleoperation.devices import REST, Axes

TURN_SPEED = 1.0  # [rad/s] at a share of 1
MARGIN = 0.05  # [s] added to the pause that the executor requires after a refusal
NO_EFFECT_TIME = 1.0  # [s] of commands without effect, after which the reason is shown


class JogSender:
    """Sends what a device requests, and reports why the arm does not follow.

    Attributes:
        frame: whose axes the device moves along.
        speed: share of 0.25 m/s and 1 rad/s.
        problem: why the arm does not follow; empty while it does.
        following: whether the arm follows.
    """

    def __init__(self, cell: Cell, frame: JogFrame, speed: float) -> None:
        """Declare the topics in a joined cell; nothing is sent yet."""
        self.frame: JogFrame = frame
        self.speed, self.problem = speed, ""
        self._bus, self._owner = cell.bus, cell.owner
        self._writer = cell.bus.writer(topics.MOTION_JOG)
        self._motion, self._owners = cell.bus.reader(topics.MOTION_STATUS), cell.bus.reader(topics.MOTION_OWNER)
        self._pressed = self._refused = self.following = False
        self._acknowledged, self._since = 0, 0.0
        self._known = 0  # stamp of the motion status when the operator began

    def update(self, axes: Axes, now: float) -> None:
        """Send a command for what is requested at a monotonic time [s], or end the motion."""
        if axes == REST:
            self.release()
            return
        motion, owner = self._motion.latest, self._owners.latest
        if motion is None or owner is None:
            self.problem = "trajectory_executor publishes no motion status"
            return
        if not self._pressed:
            self._press(motion, now)
        if self._refused:  # until the operator releases the device
            return
        self.problem = self._reason(motion, owner, now)
        if self.problem:
            self._end()
            self._refused, self.following = True, False
        elif now >= self._since:
            self._put(axes)

    def release(self) -> None:
        """End the motion that was requested, if any."""
        if self._pressed:
            self._end()
            self._pressed = self._refused = self.following = False

    def _press(self, motion: MotionStatus, now: float) -> None:
        self._pressed, self._since, self._known = True, now, motion.header.stamp
        ended = motion.message.startswith(ENDED)
        if motion.newest != self._acknowledged or ended or self.problem:
            self._acknowledged, self._since = motion.newest, now + PAUSE + MARGIN
        self.problem = ""

    def _reason(self, motion: MotionStatus, owner: MotionOwner, now: float) -> str:
        """Return why the arm does not follow, or an empty text."""
        blocking = [each.description for each in motion.interlocks
                    if each.blocks(self._owner) or each.since > self._acknowledged]
        if blocking:
            return f"the arm is {'; '.join(blocking)}"
        jogging = owner.jogging and owner.owner == self._owner
        if self.following and not jogging:
            return motion.message or "jogging was interrupted: release and press again"
        self.following = jogging
        if not jogging and motion.header.stamp > self._known and motion.message.startswith(ENDED):
            return motion.message
        if jogging or now - self._since < NO_EFFECT_TIME:
            return ""
        controlled = f"the motion is {owner.description}" if owner.kind != "none" else ""
        return controlled or motion.message or UNREACHABLE

    def _put(self, axes: Axes) -> None:
        x, y, z, roll, pitch, yaw = (self.speed * each for each in axes)
        self._send(
            linear=Vector3(x=TOOL_SPEED * x, y=TOOL_SPEED * y, z=TOOL_SPEED * z),
            angular=Vector3(x=TURN_SPEED * roll, y=TURN_SPEED * pitch, z=TURN_SPEED * yaw))

    def _end(self) -> None:
        self._send()

    def _send(self, **velocities: Any) -> None:
        self._writer.put(JogCommand(header=self._bus.header(), owner=self._owner, acknowledged=self._acknowledged,
                                    frame=self.frame, **velocities))
