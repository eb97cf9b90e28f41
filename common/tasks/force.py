"""Stages of force motions: until contact, compliant, insertion. Their line is planned once the stage before has ended.

    self.queue += [MoveUntil("touch", "PLACING", force=8.0, max_distance=0.03, touches=[("part", "table")])]

The plan request checks the straight line to `max_distance` against the planning scene, except for the pairs in
`touches`; what else it meets is a failed plan. `request` holds the other fields of a `ForceMotion`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from common import messages as m
from common.config import check
from common.messages.execution import JogFrame
from common.robot.transforms import matrix_to_pose, pose_to_matrix
from common.tasks.stages import Goal, Move, View

OVERSHOOT = 1e-3  # [m] of the plan beyond max_distance


@dataclass(eq=False)
class ForceMove(Move):
    """A straight motion of the tool that the force at it ends. The contact may be anywhere on the line."""

    kind: ClassVar[Literal["until", "comply", "insert"]]

    goal: Goal = field(default_factory=m.JointGoal, kw_only=True)  # set when it is planned
    straight: bool = field(default=True, kw_only=True)
    direction: tuple[float, float, float] = field(default=(0.0, 0.0, -1.0), kw_only=True)
    frame: JogFrame = field(default="base", kw_only=True)
    max_distance: float = field(default=0.05, kw_only=True)  # [m]
    force: float = field(default=5.0, kw_only=True)  # [N]
    zero: bool = field(default=False, kw_only=True)  # first take the wrench at rest as zero: nothing touches the tool
    fields: dict[str, Any] = field(default_factory=dict, kw_only=True)  # others of a ForceMotion

    def __post_init__(self) -> None:
        """Refuse values that no `ForceMotion` may have.

        Raises:
            ConfigError: names the field.
        """
        self.execution("check", m.JointTrajectory(joint_names=["check"], points=[]))

    def aim(self, view: View, base: NDArray[np.float64]) -> None:
        """Set the goal from where the tool is; `base` has the axes (3, 3) of the arm's base in world."""
        assert view.tcp is not None
        self.goal = m.PoseGoal(pose=line_end(view.tcp, base, self.direction, self.frame, self.max_distance))

    def execution(self, name: str, trajectory: m.JointTrajectory | None = None) -> m.ForceMotion:
        """Return the request with an id."""
        return check(m.ForceMotion, {
            "id": name, "kind": self.kind, "trajectory": trajectory or self.trajectory, "plan": self.plan,
            "scene_stamp": self.scene_stamp, "direction": dict(zip("xyz", self.direction, strict=True)),
            "frame": self.frame, "max_distance": self.max_distance, "force": self.force, "zero": self.zero,
            **self.fields}, self.name)

    def end(self) -> list[float]:
        """Return nothing: only the force decides where it ends."""
        return []

    @property
    def seconds(self) -> float:
        """Longest duration, cell time [s]."""
        return float(self.fields.get("timeout", m.ForceMotion.model_fields["timeout"].default))


class MoveUntil(ForceMove):
    """Move along a direction until the tool presses with a force."""

    kind = "until"


class Comply(ForceMove):
    """Yield to the force at the tool for `timeout` of its fields, pressing with `force`, which may be 0."""

    kind = "comply"


class Insert(ForceMove):
    """Press with a force, search a hole on a spiral, and push the held part to `depth` of its fields."""

    kind = "insert"


def line_end(
    tcp: m.Pose, base: NDArray[np.float64], direction: tuple[float, float, float],
    frame: JogFrame, distance: float,
) -> m.Pose:
    """Return the pose at the end of a line from the tool's pose in world; `base` (3, 3): axes of the arm's base."""
    T = pose_to_matrix(tcp)
    axes = {"base": base, "tool": T[:3, :3], "world": np.eye(3)}[frame]
    d = np.asarray(direction, dtype=float)
    T[:3, 3] += axes @ (d / np.linalg.norm(d)) * (distance + OVERSHOOT)
    return matrix_to_pose(T)
