"""Hand an object from the gripper of one arm to that of another one: docs/two_arms.md.

The giver holds the object at the meeting place until the gripper of the receiver reports that it holds it; then it
opens and withdraws. The receiver carries the object away once the giver has withdrawn. Each task decides by what both
grippers report and where both arms are, so that it continues after a stop or a restart.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from pydantic import Field

from common import messages as m
from common.config import Arms, Tunable
from common.config.basics import Length, Point
from common.errors import ConfigError
from common.robot.transforms import matrix_to_pose, pose_to_matrix, rpy_to_matrix
from common.tasks.handling import Handling, HandlingConfig
from common.tasks.stages import MISSES, AwaitImage, Cycle, Grip, Move, Stage, View, place_of

Array = npt.NDArray[np.float64]

AT = 0.01  # [m] from the meeting place: an object there is offered
MOVED = 0.003  # [m] an offered object that moved more is approached again
WAITS = "waits until"
ENDED = 3.0  # [s] for which the other task must have ended before this one ends, too


@dataclass(frozen=True)
class Partner:
    """The other arm now: its tool (4, 4) in world, its reports, what it holds in world, and its task."""

    name: str
    T_world_tcp: Array
    gripper: m.GripperState
    motion: m.MotionStatus
    holds: m.CollisionObject | None
    status: m.TaskStatus | None

    @property
    def has(self) -> bool:
        """Whether its gripper reports that it holds what it closed on."""
        return self.gripper.holding and self.gripper.outcome not in MISSES

    @property
    def rests(self) -> bool:
        """Whether arm and fingers are at rest."""
        return self.motion.state != "active" and not self.gripper.moving


@dataclass
class HandoverView(View):
    """View with the other arm."""

    other: Callable[[], Partner | None] = field(default=lambda: None)

    @property
    def partner(self) -> Partner | None:
        """The other arm; None while its state is unknown."""
        return self.other()


class HandoverConfig(HandlingConfig):
    """Which arm gives to which one, and where they meet."""

    arms: Arms
    gives_to: str = Field("", description="arm that this one hands objects to")
    takes_from: str = Field("", description="arm that this one takes objects from; one of both is given")
    meeting: Point = Field((0.5, 0.0, 0.45), description="center of the object when it changes hands [m], world")
    back_off: Length = Field(0.12, ge=0.1, le=0.4, description="straight line to and from that place [m]")
    meeting_speed: Tunable[float] = Field(0.08, gt=0, le=0.1, description="of the tool on that line [m/s]")

    @property
    def partner(self) -> str:
        """Name of the other arm."""
        return self.gives_to or self.takes_from

    def require_usable(self) -> None:
        """Require one role and another arm.

        Raises:
            ConfigError: names the field.
        """
        super().require_usable()
        others = [name for name in self.arms.robots if name != self.arms.own]
        if (self.gives_to and self.takes_from) or self.partner not in others:
            raise ConfigError("gives_to", self.gives_to, "and takes_from: one of both must name another arm; choices: "
                              + ", ".join(others))

    def tools_at_meeting(self, T_tcp_object: Array) -> Iterator[Array]:
        """Yield tool poses (4, 4) towards the other arm with the object at the meeting place, turned by quarters."""
        away = np.subtract(self.arms.robots[self.partner].base_position, self.robot.base_position) * (1, 1, 0)
        z = away / np.linalg.norm(away)
        for quarter in range(4):
            T = np.eye(4)
            upright = np.column_stack([np.cross((0, 0, 1), z), (0, 0, 1), z])
            T[:3, :3] = upright @ rpy_to_matrix(0.0, 0.0, quarter * math.pi / 2)
            T[:3, 3] = self.meeting - T[:3, :3] @ T_tcp_object[:3, 3]
            yield T


class Handover(Handling):
    """What giver and receiver share."""

    p: HandoverConfig

    def meets(self, view: View) -> Partner | None:
        """Return the other arm if the tools are so close that only a straight line leads away."""
        assert isinstance(view, HandoverView)
        partner = view.partner
        near = partner is not None and math.dist(view.tool, partner.T_world_tcp[:3, 3]) < 0.9 * self.p.back_off
        return partner if near else None

    def back_off(self, view: View, contact: tuple[str, str] | None = None) -> list[Stage]:
        """Withdraw in a straight line from the other gripper, go home and look."""
        partner = self.meets(view)
        if partner is None or view.tcp is None or view.gripper is None:
            return super().back_off(view, contact)
        tool = pose_to_matrix(view.tcp)
        held = partner.holds
        return [
            *([Grip("open", "HOMING", width=self.gripper.max_width)] if view.gripper.width < self.gripper.max_width - AT
              and not view.holding else []),
            self._line("withdraw", "HOMING", None, [backward(tool, self.p.back_off)], partner, held),
            self.home(view), AwaitImage()]

    def fail(self, message: str, view: View, *, go_home: bool = True) -> None:
        """Count a failure; between the grippers, only `back_off` leads home."""
        super().fail(message, view, go_home=go_home and self.meets(view) is None)

    def _line(self, name: str, state: str, cycle: Cycle | None, ends: list[Array], partner: Partner,
              held: m.CollisionObject | None) -> Move:
        """Return a slow straight line on which the gripper may touch what the other arm holds."""
        names = [] if held is None else [held.id]
        touches = [(link, f"{partner.name}/{each}") for link in self.gripper.links for each in names]
        return Move(name, state, cycle, goal=_any(ends), straight=True, tool_speed=self.p.meeting_speed,
                    may_touch=names, touches=touches)

    def _has_waited(self) -> None:
        if self.status.message.startswith(WAITS):
            self.status.message = ""

    def ends_with(self, partner: Partner | None, view: View, message: str = "") -> bool:
        """End with ERROR once the task of the other arm has; return whether it did."""
        status = None if partner is None else partner.status
        if partner is None or status is None or status.state != "ERROR":
            return False
        if self.wait_timer.elapsed("partner", view.now) >= ENDED:
            self.end("ERROR", f"the task of {partner.name} has ended: {status.message}{message}")
        return True


class Giving(Handover):
    """Brings what it holds to the meeting place and gives it to the other arm."""

    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the meeting place."""
        x, y, z = self.p.meeting
        return m.Pose(position=m.Vector3(x=x, y=y, z=z))

    def put(self, thing: m.CollisionObject, held: m.Pose, cycle: Cycle, view: View, width: float | None) -> list[Stage]:
        """Carry the object to the meeting place, the tool towards the other arm."""
        ends = list(self.p.tools_at_meeting(pose_to_matrix(held)))
        expected = None if view.holding else held
        return [
            Move("to the meeting", "PLACING", cycle, goal=_any([backward(T, self.p.back_off) for T in ends]),
                 carries=True, attach=thing.id, attach_pose=expected),
            Move("offer", "PLACING", cycle, goal=_any(ends), straight=True, carries=True, attach=thing.id,
                 attach_pose=expected, tool_speed=self.p.meeting_speed),
        ]

    def decide(self, view: View) -> None:
        """Offer what is held; open the gripper only when that of the other arm holds the object, too."""
        assert isinstance(view, HandoverView) and view.scene is not None and view.gripper is not None
        attached, partner = view.scene.attached, view.partner
        self._has_waited()
        if not view.holding and attached and self.meets(view):
            return  # the planning scene is not up to date yet: the way out is proved without the object
        if not (view.holding and attached and view.tcp is not None) or view.gripper.outcome in MISSES:
            super().decide(view)
            return
        held = attached[0].object
        at = pose_to_matrix(view.tcp) @ pose_to_matrix(held.pose)
        if math.dist(at[:3, 3], self.p.meeting) > AT:
            super().decide(view)
        elif partner is not None and partner.has and partner.rests and partner.holds and self.meets(view):
            self.queue.append(Grip("hand over", "PLACING", Cycle(held.id), width=self.gripper.max_width, carries=True,
                                   holds=False))
        elif not self.ends_with(partner, view, "; the object is still in the gripper"):
            self.status.message = f"{WAITS} {self.p.partner} holds the object"


class Receiving(Handover):
    """Takes what the other arm offers, and puts it down where `destination` says."""

    ONE_DESTINATION = True

    def decide(self, view: View) -> None:
        """Take what is offered; carry it away once the other arm has withdrawn."""
        assert isinstance(view, HandoverView) and view.gripper is not None
        partner = view.partner
        self._has_waited()
        if view.holding and view.gripper.outcome not in MISSES and (partner is None or self.meets(view)):
            if not self.ends_with(partner, view, "; the object is still in the gripper"):
                self.status.message = f"{WAITS} {self.p.partner} has withdrawn"
        elif not view.holding and partner is not None and self._offered(partner) and not self.meets(view) and (
                self._has_looked(view)):
            self._take_offered(partner)
        else:
            super().decide(view)

    def _has_looked(self, view: View) -> bool:
        """Return whether an image shows all that it has put down: its destination would be occupied otherwise."""
        return self._began is not None and view.settled_stamp > max(self.images_after, self._began)

    def _offered(self, partner: Partner) -> bool:
        return partner.has and partner.rests and partner.holds is not None and (
            math.dist(place_of(partner.holds.pose), self.p.meeting) <= AT)

    def _take_offered(self, partner: Partner) -> None:
        thing = partner.holds
        assert thing is not None
        if self._tries[thing.id] >= self.p.most_tries:
            self.end("ERROR", f"{thing.kind or thing.id} in the gripper of {partner.name}: {self._problem}")
            return
        z, T_world_object = -partner.T_world_tcp[:3, 2], pose_to_matrix(thing.pose)
        along = partner.T_world_tcp[:3, 0]
        width: float | None = thing.dimensions[0] * 2
        if thing.shape == "box" and not thing.kind:  # not detected: only its width between the other fingers is known
            width = None
        elif thing.shape == "box":
            width = thing.dimensions[int(np.abs(T_world_object[:3, :3].T @ along).argmax())]
        ends = []
        for y in (along, -along):  # the fingers close across those of the other arm
            T = np.eye(4)
            axes = [np.cross(y, z), y] if self.gripper.closing_axis == "y" else [y, np.cross(z, y)]
            T[:3, :3] = np.column_stack([*axes, z])
            T[:3, 3] = T_world_object[:3, 3] - self.p.grasp.grasp_clearance * z
            ends.append(T)
        cycle = Cycle(thing.id)
        self.queue += [
            Grip("open", "GRASPING", cycle, width=self.opening(width)),
            Move("approach", "GRASPING", cycle, goal=_any([backward(T, self.p.back_off) for T in ends]),
                 needs_full_plan=True),
            self._line("reach", "GRASPING", cycle, ends, partner, thing),
            Grip("close", "GRASPING", cycle, width=0.0, holds=True, effort=thing.grip_effort, mass=thing.mass,
                 expected_width=width, width_tolerance=self.p.width_tolerance)]
        self._place = place_of(thing.pose)

    def may_start(self, stage: Stage, view: View) -> bool:
        """Approach, reach and close only while the object is offered where it was."""
        assert isinstance(view, HandoverView)
        if stage.state != "GRASPING":
            return super().may_start(stage, view)
        partner = view.partner
        if partner is not None and self._offered(partner) and partner.holds is not None and math.dist(
                place_of(partner.holds.pose), self._place) <= MOVED:
            return super().may_start(stage, view)
        self.clear()
        self.status.message = f"{stage.name}: {self.p.partner} does not offer the object any more"
        return False


def backward(T_world_tcp: Array, distance: float) -> Array:
    """Return the tool pose (4, 4) that is farther back along the tool by a distance [m]."""
    back = T_world_tcp.copy()
    back[:3, 3] -= distance * T_world_tcp[:3, 2]
    return back


def _any(tools: list[Array]) -> m.PoseGoal | m.GoalSet:
    goals = [m.PoseGoal(pose=matrix_to_pose(tool)) for tool in tools]
    return goals[0] if len(goals) == 1 else m.GoalSet(goals=list(goals))
