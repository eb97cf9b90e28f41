"""The robot: descriptions, limits, gripper and hardware."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from common.config.basics import Length, Number, Point, Section


class ParallelLinkage(Section):
    """Fingers on parallelogram linkages, which keep their pads parallel; the driven joint is an angle, 0 when open.

    At an angle a the pads are 2 * length * (sin(open_angle - a) - sin(open_angle - closed)) apart [m].
    """

    length: Length = Field(description="of the four bars [m]")
    open_angle: float = Field(ge=-1.6, le=1.6, description="of the bars from the tool axis when open, outwards [rad]")
    closed: float = Field(gt=0, le=3.2, description="driven joint when the pads meet [rad]")


class TurningJaw(Section):
    """A finger that turns towards a fixed one; the width [m] is the distance of their tips.

    It is radius * (sin(angle + a) - sin(angle)) at an angle a from closed [rad].
    """

    radius: Length = Field(description="of its tip from the joint's axis [m]")
    angle: float = Field(ge=-1.5, le=1.5, description="of the tip from the tool axis when closed, outwards [rad]")
    closed: Number = Field(0.0, description="driven joint when closed [rad]")
    opens: Literal[1, -1] = Field(1, description="direction of the joint in which it opens")


class FingerShape(Section):
    """The tips of open fingers along the closing axis and across it, from the tool centre point."""

    inner: Length | None = Field(None, description="to the inner face; half of max_width if not given [m]")
    depth: Length = Field(0.016, description="of a tip, from its inner to its outer face [m]")
    half_width: Length = Field(0.011, description="half the width of a tip, across [m]")


class SuctionCup(Section):
    """A round suction cup at the tool centre point, along the tool's z axis."""

    lip_radius: Length = Field(0.01, description="of the ring that must be on the object [m]")
    give: Length = Field(0.005, description="compliance of the lip [m]")
    vacuum: float = Field(60_000, gt=0, le=101_325, description="pressure under it, below that of the air [Pa]")

    @property
    def force(self) -> float:
        """Largest force that pulls an object off [N]: vacuum times the area of the lip."""
        return self.vacuum * math.pi * self.lip_radius**2


class VacuumSignals(Section):
    """Digital signals of the cell that drive a suction cup: docs/suction.md."""

    output: str = Field(description="switches the vacuum on")
    input: str = Field(description="vacuum switch: on while an object seals the cup")
    timeout: float = Field(1.0, gt=0, le=60, description="from a command until the signals show its result [s]")


class PayloadConfig(Section):
    """Payload for the arm's controller; centres of mass [m] from the flange, z out of it."""

    mass: float = Field(ge=0, le=1000, description="of the gripper [kg]")
    com: Point = Field((0.0, 0.0, 0.0), description="its centre of mass [m]")
    held: Point | None = Field(None, description="centre of mass of a held object [m]; default: com")

    def with_held(self, mass: float) -> tuple[float, float, float, float]:
        """Return mass [kg] and centre of mass x, y, z [m] with a held object of this mass [kg]."""
        total, held = self.mass + mass, self.held or self.com
        x, y, z = ((self.mass * own + mass * other) / total if total else 0.0
                   for own, other in zip(self.com, held, strict=True))
        return total, x, y, z


class HardwareConfig(Section):
    """A backend, of the arm or of the gripper: a module of common/hardware or drivers, or a dotted module of a user."""

    backend: str = "mock"
    options: dict[str, Any] = {}


class GripperConfig(Section):
    """A parallel gripper: `width` is the distance between the inner faces of the fingers [m].

    The first of the joints is driven. Without a linkage it slides by half the width from `closed`. A suction cup has no
    joints. Its width is `max_width` while its valve is closed, 0 while it holds nothing, half of it while it holds an
    object.
    """

    closing_axis: Literal["x", "y"] = Field("y", description="axis of the tool centre point along which fingers close")
    fingers: FingerShape = FingerShape()
    payload: PayloadConfig | None = Field(None, description="payload for the arm's controller; default: not set")
    cup: SuctionCup | None = Field(None, description="suction cup instead of fingers")
    vacuum: VacuumSignals | None = Field(None, description="signals in `io` that drive the cup")
    group: str = Field("gripper", description="group name of the fingers")
    joints: list[str] = Field([], description="finger joints, the driven one first")
    mimic: list[Number] = Field([], description="each joint per driven joint; all 1 when empty")
    linkage: ParallelLinkage | None = Field(None, description="linkage of the driven joint; default: fingers slide")
    jaw: TurningJaw | None = Field(None, description="one finger turns and the other is fixed")
    closed: Number = Field(0.0, description="driven joint of closed sliding fingers [m]")
    travel: list[list[Number]] = Field([], description="instead of all these, rows from closed to open: the width [m] "
                                                       "and the position of each joint [rad or m]")
    links: list[str] = Field(description="links that may touch a grasped object")
    max_width: Length = Field(0.08, description="fully open [m]")
    speed: Length = Field(0.2, description="closing speed of the width [m/s]")
    acceleration: Length = Field(2.0, description="of the width [m/s^2]")
    jerk: float = Field(50.0, gt=0, le=1e4, description="of the width [m/s^3]")
    max_effort: float = Field(70.0, gt=0, le=1e4, description="largest grip force [N]")
    effort: float = Field(5.0, gt=0, le=1e4, description="grip force, if neither object nor command set it [N]")
    latency: float = Field(0.2, ge=0, le=2, description="from a command until readings show that the fingers move [s]")
    controller: str = Field("gripper_controller", description="name of its controller, the source of its state")
    named_widths: dict[str, Annotated[float, Field(ge=0, le=1)]] = Field({}, description="such as open, closed [m]")
    hardware: HardwareConfig | None = Field(None, description="backend of the gripper; default: the arm's")

    @model_validator(mode="after")
    def _fits(self) -> GripperConfig:
        if bool(self.joints) == (self.cup is not None):
            raise ValueError("gripper needs either joints or a cup")
        if self.vacuum is not None and (self.cup is None or self.hardware is not None):
            raise ValueError("gripper.vacuum needs a cup, and no gripper.hardware: signals of the cell drive it")
        if self.mimic and len(self.mimic) != len(self.joints):
            raise ValueError(f"gripper.mimic has {len(self.mimic)} values for {len(self.joints)} joints")
        if self.mimic and self.mimic[0] != 1:
            raise ValueError(f"gripper.mimic begins with the driven joint itself: 1, not {self.mimic[0]:g}")
        if self.travel:
            self._require_travel()
        if (self.linkage is not None or self.jaw is not None) and self.closed:
            raise ValueError("gripper.closed is for sliding fingers; a linkage and a jaw have their own closed")
        if self.jaw is not None:
            if self.linkage is not None or len(self.joints) != 1:
                raise ValueError("gripper.jaw needs exactly one joint and no linkage")
            most = self.jaw.radius * (1 - math.sin(self.jaw.angle))
            if self.max_width > most:
                raise ValueError(f"gripper.jaw opens by {most:.4f} m at most, max_width is {self.max_width:g} m")
        if self.linkage is not None:
            bars = self.linkage
            opens = 2 * bars.length * (math.sin(bars.open_angle) - math.sin(bars.open_angle - bars.closed))
            if not abs(opens - self.max_width) <= 1e-4:
                raise ValueError(f"gripper.linkage opens to {opens:.4f} m, but max_width is {self.max_width:g} m")
        if self.effort > self.max_effort:
            if "effort" in self.model_fields_set:
                raise ValueError(f"gripper.effort is {self.effort:g} N, more than max_effort {self.max_effort:g} N")
            object.__setattr__(self, "effort", self.max_effort)
        for name, width in self.named_widths.items():
            if width > self.max_width:
                raise ValueError(f"named width {name} is {width:g} m, more than max_width {self.max_width:g} m")
        return self

    def _require_travel(self) -> None:
        rows = self.travel
        if self.linkage is not None or self.jaw is not None or self.closed or self.mimic:
            raise ValueError("gripper.travel replaces linkage, jaw, closed and mimic: leave them out")
        if len(rows) < 2 or any(len(row) != 1 + len(self.joints) for row in rows):
            raise ValueError(f"gripper.travel needs two rows or more, each of {1 + len(self.joints)} numbers")
        steps = [[after - before for before, after in zip(row, other, strict=True)]
                 for row, other in pairwise(rows)]
        if rows[0][0] < 0 or not all(step[0] > 0 and step[1] * steps[0][1] > 0 for step in steps):
            raise ValueError("gripper.travel must have growing widths and a driven joint that turns one way")
        if abs(rows[-1][0] - self.max_width) > 1e-4:
            raise ValueError(f"gripper.travel opens to {rows[-1][0]:g} m, but max_width is {self.max_width:g} m")

    def least_time(self, distance: float) -> float:
        """Return the least time [s] of fingers at rest for a change of the width by a distance [m]."""
        stroke, ramp = max(distance, 0.0), self.speed**2 / (2 * self.acceleration)
        ramped = math.sqrt(2 * stroke / self.acceleration)
        by_speed = self.speed / self.acceleration + (stroke - ramp) / self.speed if stroke > ramp else ramped
        return max(by_speed, math.cbrt(6 * stroke / self.jerk))

    @property
    def finger_inner(self) -> float:
        """Distance from the tool centre point to the inner face of an open finger [m]."""
        return self.max_width / 2 if self.fingers.inner is None else self.fingers.inner

    @property
    def held_width(self) -> float:
        """Width of a cup that holds an object [m]."""
        return self.max_width / 2


class AttachmentConfig(Section):
    """Another URDF fixed by its root to a link of the robot, such as a gripper."""

    urdf: str = Field(description="path, or package://<package>/... from an installed description package")
    parent_link: str
    position: Point = Field((0.0, 0.0, 0.0), description="of its root in parent_link [m]")
    rpy: tuple[Number, Number, Number] = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw [rad], R = Rz Ry Rx")


class TcpConfig(Section):
    """A tool centre point that is not in the URDF, fixed to one of its links."""

    link: str = Field(description="its name")
    parent: str
    position: Point = Field((0.0, 0.0, 0.0), description="in parent [m]")
    rpy: tuple[Number, Number, Number] = Field((0.0, 0.0, 0.0), description="roll, pitch, yaw [rad], R = Rz Ry Rx")


class WrenchConfig(Section):
    """How the measured wrench at the tool is processed."""

    bandwidth: float = Field(20.0, ge=0.5, le=500, description="of the first-order low-pass, at -3 dB [Hz]")
    inertia: bool = Field(True, description="subtract the force that accelerates the payload")


class RobotConfig(Section):
    """A robot: its descriptions, its planning group, and limits that are not in the URDF."""

    name: str
    urdf: str = Field(description="path, or package://<package>/... from an installed description package")
    srdf: str = Field("", description="as urdf, for its disabled collision pairs")
    package_dirs: list[str] = Field([], description="folders for package://, searched before the installed packages")
    attachments: list[AttachmentConfig] = Field([], description="descriptions added to the URDF")
    group: str = "arm"
    group_aliases: list[str] = []
    visual_as_collision: list[str] = Field(
        [], description="links that collide with their visual shapes, as they have no collision shapes"
    )
    allowed_pairs: list[tuple[str, str]] = Field(
        [], description="pairs of links that may touch, besides those that the SRDF disables"
    )
    joints: list[str] = Field(min_length=1, description="joints of the group, in order")
    base_link: str
    base_position: Point = Field((0.0, 0.0, 0.0), description="of base_link in world [m]")
    base_rpy: tuple[Number, Number, Number] = Field(
        (0.0, 0.0, 0.0), description="of base_link in world: roll, pitch, yaw [rad], R = Rz Ry Rx"
    )
    tcp_link: str = Field("", description="link of the tool centre point; not needed if `tcp` defines it")
    tcp: TcpConfig | None = Field(None, description="tool centre point, if the URDF has no link for it")
    flange_link: str = Field(
        "", description="link of the flange, from which payloads are given and at which a wrench is measured; default: "
                        "parent of the first attachment, else the link that the last joint moves"
    )
    locked_joints: dict[str, Number] = Field(
        {}, description="positions of joints outside the group in planning; fingers while their width is unknown"
    )
    named_poses: dict[str, list[Number]] = Field(description="joint positions [rad]; must have home")
    position_limits: list[tuple[Number, Number]] = Field(
        [], description="lower and upper limit of each joint [rad]; default: the URDF's"
    )
    velocity_limits: list[Annotated[float, Field(gt=0, le=100)]] = Field([], description="[rad/s]; default: the URDF's")
    acceleration_limits: list[Annotated[float, Field(gt=0, le=1000)]] = Field(description="[rad/s^2]")
    deceleration_limits: list[Annotated[float, Field(gt=0, le=1000)]] = Field(
        [], description="when braking for a hold or a stop [rad/s^2]; default: acceleration_limits"
    )
    jerk_limits: list[Annotated[float, Field(gt=0, le=1e6)]] = Field(description="[rad/s^3]")
    controller: str = Field("controller", description="name of the arm's controller, the source of its status")
    gripper: GripperConfig | None = None
    wrench: WrenchConfig = WrenchConfig()
    force_limit: float = Field(
        60.0, gt=0, le=1000, description="hard limit of force motions: a larger force at the tool ends them [N]")
    torque_limit: float = Field(
        10.0, gt=0, le=1000, description="the same of the torque at the tool centre point [N m]")
    hardware: HardwareConfig = HardwareConfig()

    @property
    def cup_signals(self) -> dict[str, str]:
        """Kind, input or output, of the cell's signals that drive its suction cup, by name."""
        vacuum = self.gripper.vacuum if self.gripper is not None else None
        return {} if vacuum is None else {vacuum.output: "output", vacuum.input: "input"}

    @model_validator(mode="before")
    @classmethod
    def _set_tcp_link(cls, values: Any) -> Any:
        tcp = values.get("tcp") if isinstance(values, dict) else None
        link = tcp.get("link") if isinstance(tcp, dict) else getattr(tcp, "link", None)
        return values | {"tcp_link": link} if link and not values.get("tcp_link") else values

    @model_validator(mode="after")
    def _require_lengths(self) -> RobotConfig:
        if not self.tcp_link:
            raise ValueError("tcp_link must be given, or tcp")
        if self.tcp is not None and self.tcp.link != self.tcp_link:
            raise ValueError(f"tcp_link is {self.tcp_link}, but tcp defines {self.tcp.link}")
        optional = ("position_limits", "velocity_limits", "deceleration_limits")
        for field in (*optional, "acceleration_limits", "jerk_limits"):
            if field in optional and not getattr(self, field):
                continue
            if len(getattr(self, field)) != len(self.joints):
                raise ValueError(f"{field} has {len(getattr(self, field))} values for {len(self.joints)} joints")
        if "home" not in self.named_poses:
            raise ValueError("named_poses must have home")
        for name, positions in self.named_poses.items():
            if len(positions) != len(self.joints):
                raise ValueError(f"named pose {name} has {len(positions)} values for {len(self.joints)} joints")
        return self
