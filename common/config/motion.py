"""How the robot moves and grasps, and which planners are asked."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, Field

from common.config.basics import Section, Tunable
from common.remapping import is_cell


class Motion(Section):
    """How fast the robot moves and how hard planning tries, unless a request says otherwise."""

    velocity_scaling: Tunable[float] = Field(0.2, gt=0, le=1, description="fraction of the joints' velocity limits")
    acceleration_scaling: Tunable[float] = Field(
        0.2, gt=0, le=1, description="fraction of the joints' acceleration limits"
    )
    cartesian_speed_scale: Tunable[float] = Field(
        1.0, gt=0, le=1, description="stretch of straight-line trajectories after retiming: t/s, v*s, a*s^2"
    )
    planning_attempts: Tunable[int] = Field(
        5, ge=1, le=100, description="tries of a sampling planner, the best is kept"
    )
    planning_time: Tunable[float] = Field(10.0, gt=0, le=600, description="wall time for one plan [s]")
    object_padding: Tunable[float] = Field(
        0.003, ge=0, le=0.05, description="perceived objects are planned around with this much more radius [m]"
    )
    start_tolerance: Tunable[float] = Field(
        0.05, ge=0, le=0.5, description="where a joint stands this far beyond its limit a plan begins inwards [rad]"
    )


class Grasp(Section):
    """How an object is taken and put down, for the tool centre point with the tool pointing down."""

    approach_clearance: float = Field(0.10, ge=0.02, le=0.5, description="pre-grasp above the grasp [m]")
    grasp_clearance: float = Field(0.0, ge=-0.02, le=0.05, description="grasp above the centre of the object [m]")
    min_grasp_z: float = Field(0.012, ge=0.0, le=0.5, description="the tool centre point never goes below this [m]")
    lift_height: float = Field(0.15, ge=0.05, le=0.5, description="lift above the grasp [m]")
    drop_z: float = Field(0.225, ge=0.18, le=0.6, description="height of release above the container [m]")

    max_tilt: float | None = Field(
        None, ge=0.0, le=1.5, description="the tool is tilted by so much at most where it grasps [rad]; without a "
        "value 0, and 0.35 for an arm that cannot choose: one of fewer than six joints")

    def tilt(self, joints: int) -> float:
        """How far an arm of so many joints may be from pointing down where it grasps [rad]."""
        return self.max_tilt if self.max_tilt is not None else 0.0 if joints >= 6 else 0.35

    def height(self, z: float) -> float:
        """Of the tool centre point at the grasp of what has its centre at z [m]."""
        return max(z + self.grasp_clearance, self.min_grasp_z)


class PlannerEntry(Section):
    """A planner of the pipeline: a module of common/planning/planners, or a dotted module of your own."""

    name: str
    options: dict[str, Any] = {}


class Pipeline(Section):
    """Planners in the order in which they are tried, and the checks after them."""

    planners: list[PlannerEntry] = Field(min_length=1)
    validation_step: Tunable[float] = Field(
        0.01, gt=0, le=0.2, description="largest joint step between checked states [rad]"
    )


def _cell(name: str) -> str:
    if not is_cell(name):
        raise ValueError(f"{name!r} is no name of a cell, which begins all its keys: take letters, digits, _, - and .")
    return name


class Run(Section):
    """What belongs to one run."""

    cell: Annotated[str, AfterValidator(_cell)]
    seed: int = Field(0, ge=0, le=2**31 - 1)
    autostart: bool = True


class Watchdogs(Section):
    """Patience with processes that are alive and do nothing; wall time."""

    loop: float = Field(
        5.0, ge=0, le=600, description="a service whose event loop does not turn for so long ends itself; 0: never [s]"
    )
    silence: float = Field(
        7.0, ge=0, le=600, description="a process not heard of for so long is killed and started again; 0: never [s]"
    )
    start: float = Field(
        60.0, ge=5, le=600, description="one that is started again and not ready for so long is killed too [s]"
    )
