"""Manual control on the page: jog buttons, gripper buttons, and numeric display of the arm's pose.

The arm jogs only while a button is held down. The page sends a message every 40 ms (overlay.js), and each becomes one
`JogCommand`, which is never repeated: when messages cease, the executor brakes 0.1 s after the last one. A stop, a
hold, or another page's jog ends it until the button is released.
"""

from __future__ import annotations

import math
from collections.abc import Awaitable, Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
import viser
from numpy.typing import NDArray

from common import topics
from common.client.operator_motion import UNREACHABLE
from common.config import check
from common.control.jogging import ENDED, PAUSE
from common.messages import GripperCommand, Interlock, MotionOwner, MotionStatus
from common.robot.transforms import matrix_to_rpy
from common.time_source import monotonic, new_id
from page.control_socket import HoldHandler
from page.diagnostics import short_names
from page.markup import Html, block, buttons, hold, live, press, text

if TYPE_CHECKING:
    from common.config import GripperConfig
    from common.robot.model import RobotModel
    from page.access import Permissions
    from page.console import ActionQueue, Console
    from page.feeds import Latest

Array = NDArray[np.float64]
Numbers = tuple[float, float, float]
Velocities = Mapping[str, Any]  # fields of a JogCommand

NO_EFFECT_TIMEOUT = 1.0  # [s] of jog messages without effect, after which that is reported
EXCLUSIVE_TIME = 0.5  # [s] after the last message of a page, in which no other page jogs
TOOL_SPEED, TURN_SPEED = 0.25, 1.0  # [m/s] reduced speed of ISO 10218-1, [rad/s], at 100 %
INITIAL_SPEED = 20  # [%]
FRAMES = ("base", "tool", "world")
AXES = "xyz"


class ArmReadout:
    """The arm's joints in degrees (prismatic ones in mm), and the pose of its tool in mm and degrees.

    Attributes:
        scales: (dof,) factors from joint positions [rad, m] to displayed values.
        units: of the displayed values.
    """

    def __init__(self, robot: RobotModel, latest: Latest) -> None:
        """Read a robot, which no other thread uses, from the newest joint states."""
        self._robot, self._latest = robot, latest
        prismatic = [joint.shortname().startswith("JointModelP") for joint in robot.model.joints[1:]]
        self.scales: Array = np.where(prismatic, 1e3, 180 / math.pi)
        self.units = ["[mm]" if each else "[°]" for each in prismatic]

    def joints(self) -> Array | None:
        """Return the joint positions (dof,) [rad, m], if known."""
        state = self._latest(topics.JOINT_STATES)
        return self._robot.order(state.name, state.position) if state is not None else None

    def tool(self, q: Array) -> tuple[list[float], list[float]]:
        """Return position [m] and roll, pitch, yaw [rad] of the tool center point in world; q (dof,)."""
        T_world_tcp = self._robot.fk(q)
        position, rpy = T_world_tcp[:3, 3], matrix_to_rpy(T_world_tcp[:3, :3])
        return [float(each) for each in position], [float(each) for each in rpy]

    def convert(self, q: Array) -> tuple[Numbers, Numbers, list[float]]:
        """Return tool position [mm] and roll, pitch, yaw [degrees] in world, and joint values, rounded; q (dof,)."""
        position, rpy = self.tool(q)
        x, y, z = (round(1e3 * value, 1) for value in position)
        roll, pitch, yaw = (round(math.degrees(value), 1) for value in rpy)
        return (x, y, z), (roll, pitch, yaw), [round(float(value), 2) for value in q * self.scales]

    def live(self) -> dict[str, str]:
        """Return the current values by their names in `markup.live`; empty while they are unknown."""
        q = self.joints()
        if q is None:
            return {}
        xyz, rpy, joints = self.convert(q)
        shown = {f"j:{name}": f"{value:.1f} {unit.strip('[]')}"
                 for name, value, unit in zip(self._robot.joint_names, joints, self.units, strict=True)}
        shown |= {f"p:{axis}": f"{value:.1f} mm" for axis, value in zip(AXES, xyz, strict=True)}
        return shown | {f"r:{axis}": f"{value:.1f} °" for axis, value in zip(AXES, rpy, strict=True)}


# --- jogging ---


class JogSender(Protocol):
    """Sends jog commands: `Console`."""

    permissions: Permissions

    def jog(self, acknowledged: int, **velocities: Any) -> None:
        """Move with velocities for a moment; without any come to a stop."""


class Jogger(HoldHandler):
    """Turns messages of a held button into jog commands; one page at a time."""

    def __init__(
        self, sender: JogSender, velocities: Callable[[str], Velocities | None],
        state: Callable[[], tuple[MotionStatus | None, MotionOwner | None]], arm_blocked: Callable[[], str],
    ) -> None:
        """Create a jogger.

        Args:
            sender: sends the commands.
            velocities: returns the velocities of a button by its name.
            state: returns motion status and motion owner.
            arm_blocked: returns why the arm cannot be moved, or an empty text.
        """
        self._sender, self._velocities, self._state, self._arm_blocked = sender, velocities, state, arm_blocked
        self._client: object = None  # that jogs
        self._press: tuple[object, int] | None = None  # newest press: client and number
        self._last_message, self._started, self._acknowledged = 0.0, 0.0, 0
        self._moved = False  # whether the arm has moved during this press

    def hold(self, client: object, button: str, press: int, reject: Callable[[str], None]) -> None:
        """Jog for the next 0.1 s, or reject the press for good with the reason."""
        velocities, now = self._velocities(button), monotonic()
        if velocities is None:
            return
        if self._client not in (None, client) and now - self._last_message < EXCLUSIVE_TIME:
            reject("Another page is jogging the arm")
            return
        is_new = self._press != (client, press)
        if not is_new and self._client is None:
            return  # the press was rejected or released
        motion, owner = self._state()
        newest = motion.newest if motion is not None else 0
        reason = self._arm_blocked() or self._interlocked(motion)
        if not (reason or is_new) and motion is not None and newest > self._acknowledged:
            reason = f"the arm is {_names(motion.interlocks[-1:])}"
        ended = motion.message if motion is not None and motion.message.startswith(ENDED) else ""
        reason = reason or self._without_effect(owner, is_new, now, ended)
        if is_new:
            self._press, self._started = (client, press), now
            if newest != self._acknowledged or ended:  # the executor requires a pause before it accepts commands again
                self._acknowledged, self._started = newest, now + PAUSE
        if reason:
            self.release(client)
            self._client = None
            reject(f"Jogging rejected: {reason}")
            return
        self._client, self._last_message = client, now
        if now >= self._started:
            self._sender.jog(self._acknowledged, **velocities)

    def release(self, client: object) -> None:
        """Stop the arm if this page jogs it."""
        if client is self._client:
            self._client = None
            self._sender.jog(self._acknowledged)

    def _interlocked(self, motion: MotionStatus | None) -> str:
        """Return the stops and holds of other operators."""
        client = self._sender.permissions.client_name
        interlocks = motion.interlocks if motion is not None else []
        blocking = _names(one for one in interlocks if one.blocks(client))
        return f"the arm is {blocking}" if blocking else ""

    def _without_effect(self, owner: MotionOwner | None, is_new: bool, now: float, ended: str) -> str:
        """Return why jogging has ended, with the executor's reason `ended`, or has had no effect for a second."""
        jogging = owner is not None and owner.jogging and owner.owner == self._sender.permissions.client_name
        self._moved = jogging or (self._moved and not is_new)
        if ended and self._moved and not jogging:
            return ended
        if owner is None or is_new or jogging or now - self._started <= NO_EFFECT_TIMEOUT:
            return ""
        if self._moved and owner.kind == "none" and not owner.jogging:
            return "the connection was interrupted (slow network or busy machine): press the button again"
        controlled = f"; {owner.owner or owner.kind} controls the arm" if owner.kind != "none" else ""
        return ended or f"{UNREACHABLE}{controlled}"


def _names(interlocks: Iterable[Interlock]) -> str:
    return ", ".join(f"{one.kind} by {one.by}" + (f" ({one.reason})" if one.reason else "") for one in interlocks)


class JogPanel:
    """Buttons to hold down for each joint and each axis of the tool, with the current values between them."""

    def __init__(self, gui: viser.GuiApi, actions: ActionQueue, joints: Sequence[str], limits: Sequence[float]) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            actions: runs changes of the fields.
            joints: names, in order.
            limits: their velocity limits [rad/s].
        """
        self._joints, self._limits = list(joints), list(limits)
        self._frame, self._speed, self._disabled = FRAMES[0], INITIAL_SPEED / 100, ""
        self._html = Html(gui, self._buttons())
        speed = gui.add_slider("Jog speed [%]", 1, 100, 1, INITIAL_SPEED, hint=(
            "100 % is 250 mm/s and 1 rad/s for the tool, and the velocity limit for a joint"))
        actions.on_change(speed, self._set_speed)
        frame = gui.add_dropdown("Tool axes of", FRAMES, initial_value=FRAMES[0],
                                 hint="frame whose axes the tool moves along and rotates about")
        actions.on_change(frame, self._set_frame)

    def show(self, disabled: str) -> None:
        """Disable the buttons for a reason, or enable them."""
        self._disabled = disabled
        self._html.set(self._buttons())

    def velocities(self, button: str) -> Velocities | None:
        """Return the velocities of a button, as fields of a `JogCommand`; None for an unknown button."""
        kind, _, rest = button.partition(":")
        name, _, sign = rest.rpartition(":")
        if sign not in ("+", "-"):
            return None
        factor = self._speed if sign == "+" else -self._speed
        if kind == "joint" and name in self._joints:
            return {"joints": {name: factor * self._limits[self._joints.index(name)]}}
        frame, _, axis = name.rpartition(":")
        if frame not in FRAMES or len(axis) != 1 or axis not in AXES or kind not in ("move", "turn"):
            return None
        field, limit = ("linear", TOOL_SPEED) if kind == "move" else ("angular", TURN_SPEED)
        return {"frame": frame, field: {axis: factor * limit}}

    def _buttons(self) -> str:
        joints = [self._row(short, f"joint:{name}", short if "joint" in short.lower() else f"joint {short}",
                            f"j:{name}") for name, short in zip(self._joints, short_names(self._joints), strict=True)]
        tool = [self._row(axis.upper(), f"move:{self._frame}:{axis}", f"tool along {axis}", f"p:{axis}")
                for axis in AXES]
        tool += [self._row(f"R{axis.upper()}", f"turn:{self._frame}:{axis}", f"rotate tool about {axis}", f"r:{axis}")
                 for axis in AXES]
        columns = "".join(f'<div>{"".join(rows)}</div>' for rows in (joints, tool))
        note = self._disabled or f"Hold a button to move a joint (left) or the tool (right, axes of {self._frame}, " \
                                 f"position in world). Collisions are not checked."
        return block(f'<div class="pad">{columns}</div><div class="dim small">{text(note)}</div>', "jog")

    def _row(self, label: str, name: str, spoken: str, number: str) -> str:
        minus = hold("−", f"{name}:-", f"jog {spoken}, minus", self._disabled)
        plus = hold("+", f"{name}:+", f"jog {spoken}, plus", self._disabled)
        return f'<div>{minus}<span class="name"><span class="dim">{text(label)}</span>{live(number)}</span>{plus}</div>'

    def _set_frame(self, frame: str) -> None:
        self._frame = frame
        self._html.set(self._buttons())

    def _set_speed(self, percent: float) -> None:
        self._speed = min(max(percent, 1.0), 100.0) / 100


# --- gripper ---


class GripperPanel:
    """Buttons that open and close the gripper, or move it to a width.

    Attributes:
        buttons: HTML of the buttons that open and close it.
    """

    def __init__(
        self, gui: viser.GuiApi, console: Console, gripper: GripperConfig,
        require_free: Callable[[], Awaitable[MotionStatus]],
    ) -> None:
        """Build the panel.

        Args:
            gui: of the server.
            console: sends the commands.
            gripper: of the robot file.
            require_free: returns the motion status; raises if another client controls the arm.
        """
        self._console, self._require_free, self._gripper = console, require_free, gripper
        self._width, self._force = 1e3 * gripper.max_width, gripper.effort
        widest = round(self._width, 1)
        width = gui.add_number("Width [mm]", widest, min=0.0, max=widest, step=0.1)
        force = gui.add_number("Force [N]", round(self._force, 1), min=0.0, max=gripper.max_effort, step=0.1)
        console.on_change(width, self._set_width)
        console.on_change(force, self._set_force)
        for name, target in (("open", lambda: 1e3 * gripper.max_width), ("close", lambda: 0.0),
                             ("width", lambda: self._width)):
            console.on_press(f"gripper:{name}", self._command(name, target), f"Gripper: {name}")
        self._html, self.buttons = Html(gui), ""

    def show(self, disabled: str) -> None:
        """Disable the buttons for a reason, or enable them."""
        self.buttons = "".join(press(label, f"gripper:{name}", disabled, arm=True)
                               for label, name in (("Open", "open"), ("Close", "close")))
        self._html.set(block(buttons(press("Move to width", "gripper:width", disabled, arm=True)), "gripper"))

    def _command(self, name: str, width: Callable[[], float]) -> Callable[[], Any]:
        async def command() -> None:
            acknowledged = (await self._require_free()).newest
            request = check(GripperCommand, {
                "header": self._console.header(), "acknowledged": acknowledged,
                "id": f"page-{new_id()}", "owner": self._console.permissions.client_name,
                "width": width() * 1e-3, "effort": self._force}, "gripper")
            self._console.notify(f"Gripper: {name} …", "busy")
            state = await self._console.call(topics.GRIPPER_COMMAND, request)
            if state.state == "rejected":
                self._console.notify(f"Gripper command rejected: {state.message}")
            else:
                self._console.notify(f"Gripper: {name}", "good")

        return command

    def _set_width(self, width: float) -> None:
        self._width = min(max(width, 0.0), 1e3 * self._gripper.max_width)

    def _set_force(self, force: float) -> None:
        self._force = min(max(force, 0.0), self._gripper.max_effort)
