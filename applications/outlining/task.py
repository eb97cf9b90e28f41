"""The outlining task: trace the selected contour once, then return home.

All motions, including the return home, are planned before the arm moves: above the objects it occludes them. A failure
ends in ERROR with one line and the arm at rest, at home if it can get there.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from pydantic import Field, ValidationError

from applications.outlining.topics import OutlinePoints, OutlineStatus
from common import messages as m
from common.config import GripperConfig, Number, Parameters, Tunable
from common.robot.transforms import matrix_to_pose, rpy_to_matrix, transform
from common.tasks.decisions import TaskConfig
from common.tasks.engine import Task
from common.tasks.stages import AwaitImage, Cycle, Grip, Move, Place, Stage, View, place_of

NEAR = 0.01  # [m] accuracy of a perceived object


@dataclass
class OutlineView(View):
    """View with the path along the selected contour."""

    path: OutlinePoints | None = None

    @property
    def stamps(self) -> tuple[float, ...]:
        """Time of the image with the contour [s]."""
        return (self.path.header.stamp * 1e-9 if self.path else 0.0,)

    def solid(self) -> str | None:
        """Return the id of the perceived object that the path surrounds; None while it is not in the planning scene.

        A path from a file need not surround an object: then the id of the nearest one, or an empty string.
        """
        if self.path is None or self.scene is None or self.scene.header.stamp < self.path.header.stamp:
            return None
        places = [place_of(pose) for pose in self.path.poses]
        near_counts = {o.id: sum(_is_near(o, at) for at in places) for o in self.scene.objects if o.role == "target"}
        if self.path.given:
            return max((name for name, count in near_counts.items() if count), key=near_counts.__getitem__, default="")
        around = [o for o in self.scene.objects if near_counts.get(o.id) == len(places)]
        return min(around, key=_area).id if around else None


def _is_near(thing: m.CollisionObject, place: Place) -> bool:
    """Return whether a position lies within the bounding box of an upright prism."""
    at = thing.pose.position
    xs, ys = zip(*thing.outline, strict=True) if thing.outline else ((0.0,), (0.0,))
    x, y, z = place
    return (min(xs) - NEAR <= x - at.x <= max(xs) + NEAR and min(ys) - NEAR <= y - at.y <= max(ys) + NEAR
            and abs(z - at.z) <= thing.dimensions[-1] / 2 + NEAR)


def _area(thing: m.CollisionObject) -> float:
    xs, ys = zip(*thing.outline, strict=True) if thing.outline else ((0.0,), (0.0,))
    return float((max(xs) - min(xs)) * (max(ys) - min(ys)))


def closed(path: OutlinePoints) -> list[Place]:
    """Return the points of a path [m], followed by the first one."""
    points = [place_of(pose) for pose in path.poses]
    return [*points, points[0]]


def same_place(path: OutlinePoints, other: OutlinePoints | None) -> bool:
    """Return whether the bounding boxes of two paths are equal within the accuracy of perception."""
    if other is None or not path.poses or not other.poses:
        return False
    a, b = (np.array([place_of(pose) for pose in each.poses]) for each in (path, other))
    return bool(np.abs([a.min(axis=0) - b.min(axis=0), a.max(axis=0) - b.max(axis=0)]).max() <= NEAR)


def length(points: list[Place]) -> float:
    """Return the length [m] of the polyline through points."""
    return sum(math.dist(a, b) for a, b in pairwise(points))


class TracingParameters(Parameters):
    """Parameters of the motion along a contour."""

    standoff: Tunable[float] = Field(
        0.002, ge=0, le=0.2, description="of the finger tips above the contour, which they must not drag [m]"
    )
    approach_clearance: Tunable[float] = Field(
        0.10, gt=0, le=0.5, description="approach and retreat above the contour [m]"
    )
    tool_rpy: Tunable[tuple[Number, Number, Number]] = Field(
        (0.0, -math.pi, -math.pi), description="of the tool in world while tracing [rad], R = Rz Ry Rx"
    )
    tool_speed: Tunable[float] = Field(
        0.05, gt=0, le=1, description="along the contour, where limits and corners allow [m/s]"
    )
    step: Tunable[float] = Field(0.001, ge=1e-4, le=0.05, description="along the contour between IK solutions [m]")
    min_fraction: Tunable[float] = Field(0.99, gt=0, le=1, description="of the contour that must be possible")


@dataclass(frozen=True)
class MotionSegments:
    """Creates the motion segments from heights and speed; has no state."""

    p: TracingParameters
    gripper: GripperConfig

    def outline(self, points: list[Place], solid: str, cycle: Cycle) -> list[Move]:
        """Return above the first point, down, along all points, up, home."""
        x, y, z = points[0]
        touches = [(link, solid) for link in self.gripper.links] if solid else []
        trace = m.PathGoal(waypoints=[self._pose(p) for p in points], step=self.p.step,
                           min_fraction=self.p.min_fraction, tool_speed=self.p.tool_speed)
        above = m.PoseGoal(pose=self._pose((x, y, z + self.p.approach_clearance)))
        down = m.PoseGoal(pose=self._pose(points[0]))
        return [
            Move("approach", "APPROACHING", cycle, goal=above, needs_fresh_image=True, needs_full_plan=True),
            Move("descend", "APPROACHING", cycle, goal=down, straight=True, touches=touches),
            Move("trace", "TRACING", cycle, goal=trace, touches=touches),
            Move("retreat", "RETREATING", cycle, goal=above, straight=True, touches=touches),
            self.home(cycle),
        ]

    def home(self, cycle: Cycle) -> Move:
        """Return the motion to the pose from which the camera sees everything."""
        return Move("home", "HOMING", cycle, goal=m.JointGoal(named="home"))

    def _pose(self, at: Place) -> m.Pose:
        x, y, z = at
        return matrix_to_pose(transform(rpy_to_matrix(*self.p.tool_rpy), (x, y, z + self.p.standoff)))


AT_HOME = 0.01  # [rad] tolerance
MOST_FORGOTTEN = 5  # consecutive motions interrupted by a restart of the controller
SHUT = 0.002  # [m] fingers this close together count as closed


class Config(TracingParameters, TaskConfig):
    """Parameters of the task; times are cell time unless they say wall."""

    planning_time: Tunable[float] = Field(10.0, gt=0, le=600, description="wall time for one plan [s]")
    overtime: Tunable[float] = Field(
        30.0, gt=0, le=3600, description="a motion that takes so much longer is stopped [s]"
    )
    frame_timeout: Tunable[float] = Field(
        3.0, ge=0.1, le=60, description="a contour from an older picture starts no motion [s, wall time]"
    )
    selection_timeout: Tunable[float] = Field(
        10.0, ge=0, le=3600, description="wait for a usable contour while pictures come, before giving up; 0: for "
                                         "ever [s, wall time]"
    )
    picture_timeout: Tunable[float] = Field(
        60.0, ge=0, le=3600, description="wait for pictures while none comes, before giving up; longer than a camera "
                                         "or detector takes to be started again; 0: for ever [s, wall time]"
    )


class Outline(Task[OutlineView]):
    """Traces a contour. After a stop the arm returns home and starts again: outlines are traced completely."""

    p: Config
    status: OutlineStatus

    def __init__(self, config: Config, status: OutlineStatus, prefix: str, speed: float = 1.0) -> None:
        """Start with nothing known: see `Task`."""
        super().__init__(config, status, prefix, speed)
        self.status.standoff = config.standoff
        self._segments = MotionSegments(config, self.gripper)
        self._home = config.robot.named_poses["home"]
        self._cycle = Cycle()
        self._traced = False
        self._returned = False  # home was reached and not left since
        self._error = ""  # the failure that ends the task once the arm is home
        self._forgotten = 0  # interrupted motions since the last successful one
        self._up: Move | None = None  # first motion of a return home from anywhere
        self._excused: tuple[str, str] | None = None  # contact that the arm has to be freed from
        self._path: OutlinePoints | None = None  # path that the motions were created for
        self._named: dict[str, Place] = {}  # positions of the objects at that time, by id

    # --- what to do next -------------------------------------------------------------------------------------

    def decide(self, view: OutlineView) -> None:
        """Go home first, end, or look for a contour and plan around it."""
        if self.status.state == "DONE":
            return
        if not self._is_home(view):
            self._recover(view)
        elif self._error:
            self._give_up(self._error)
        elif self._traced:
            self.end("DONE")
        else:
            self._select(view)

    def _select(self, view: OutlineView) -> None:
        """Take the selected contour once the planning scene has its object; fail after a while without one."""
        self.status.state, self.status.stage = "SELECTING", ""
        path = view.path
        if path is not None and min(view.stamps) < self.images_after:
            path = None
        solid = view.solid()
        unseen = "no contour received from the camera" if path is None else self.unseen(view)
        if path is not None and len(path.poses) > 1 and solid is not None and not unseen:
            self._take(path, solid, view)
            return
        if path is None or unseen:
            problem = unseen
        elif not path.poses:
            problem = path.message or "no object is chosen"
        elif len(path.poses) < 2:  # noqa: PLR2004 - a point has no outline
            problem = f"the contour of {path.object} is a single point"
        else:
            problem = f"the planning scene does not hold {path.object or 'the object'} around which the contour goes"
        self.status.message = problem
        # Waiting for an operator or for images takes wall time, also in a fast cell.
        limit = self.p.picture_timeout if unseen else self.p.selection_timeout
        waited = self.wait_timer.elapsed(bool(unseen), view.now)
        if 0 < limit * self.speed < waited:
            self.fail(problem, view)

    def _take(self, path: OutlinePoints, solid: str, view: OutlineView) -> None:
        """Queue the motions for a contour around a solid of the planning scene."""
        assert view.gripper is not None
        points, cycle = closed(path), Cycle(path.object)
        try:
            motions = self._segments.outline(points, solid, cycle)
        except ValidationError:  # a path may fill a message completely
            self.fail(f"the contour of {path.object} has too many points, or lies too far away", view)
            return
        status = self.status
        status.state, status.message, status.subject = "PLANNING", "", path.object
        status.points, status.length_m, status.fraction, status.closed = len(path.poses), length(points), 0.0, False
        status.invalid_depth, status.standoff = path.invalid_depth, self.p.standoff
        self._cycle = cycle
        self._path, self._named = path, _places(view)
        if view.gripper.width > SHUT:
            self.queue.append(Grip("close", "PLANNING", self._cycle, width=0.0))
        self.queue += [*motions, AwaitImage()]
        self.wait_timer.reset()

    def _is_home(self, view: OutlineView) -> bool:
        assert view.q is not None
        return self._returned or max(abs(a - b) for a, b in zip(view.q, self._home, strict=True)) < AT_HOME

    # --- what happened ---------------------------------------------------------------------------------------

    def on_restart(self) -> None:
        """Forget the last outline."""
        self.status.closed = self._traced = False

    def note(self, view: OutlineView) -> None:
        """Note that the arm has left home when another client moves it."""
        if self.running is None and view.motion is not None and view.motion.state == "active":
            self._returned = False

    def planned(self, move: Move, response: m.PlanResponse) -> None:
        """Record the traceable fraction of the contour, also when it is too small."""
        if move.name == "trace":
            self.status.fraction = response.fraction

    def may_start(self, stage: Stage, view: OutlineView) -> bool:
        """Start only with a fresh image that shows the contour where it was planned."""
        if isinstance(stage, Move) and stage.needs_fresh_image and self.unseen(view):
            self.clear()
            self.wait_timer.reset()
            return False
        if isinstance(stage, Move) and stage.needs_fresh_image and self._path and not same_place(self._path, view.path):
            self.displaced(stage, view, f"{self.status.subject or 'the contour'} is not where it was")
            return False
        if isinstance(stage, Move):
            self._returned = False
        return True

    def succeeded(self, stage: Stage, view: OutlineView) -> None:
        """Record the success of a stage."""
        self._forgotten = 0
        if stage.name == "trace":
            self._traced, self.status.closed = True, self.status.fraction >= 1
        elif stage.name == "home":
            self._returned, self._excused = True, None

    def forgotten(self, stage: Stage, view: OutlineView) -> None:
        """Decide again from home: a restart of the controller is no fault of the motion."""
        self.displaced(stage, view, f"{stage.name} was forgotten by the controller")

    def displaced(self, stage: Stage, view: OutlineView, problem: str) -> None:
        """Decide again from home, also when the controller was restarted before it could answer."""
        self._forgotten += 1
        if self._forgotten > MOST_FORGOTTEN:
            self.fail(problem, view)
            return
        self.clear()
        self.wait_timer.reset()
        self.status.failures += 1
        self._returned, self.status.message = False, problem

    def obstructed(self, stage: Stage, view: OutlineView, problem: str) -> None:
        """Decide again from home, where the obstacle is visible; outlines are traced completely."""
        self.displaced(stage, view, problem)

    # --- failure ---------------------------------------------------------------------------------------------

    def plan_failed(self, move: Move, response: m.PlanResponse, view: OutlineView) -> None:
        """Fail, or skip an impossible part of the return home: the arm may be at its highest point."""
        if move is self._up and response.colliding and self._excused is None:
            self._excused = response.colliding  # free the arm from the contact
            self._recover(view)
        elif move is self._up:
            self.clear()
            self.queue += [self._segments.home(self._cycle), AwaitImage()]
        elif not self._error and self._is_new(response.colliding or (), view):
            self.displaced(move, view, response.message)
        elif not self._error:
            subject = self.status.subject
            self.fail(f"{subject}: {response.message}" if subject else response.message, view)
        else:
            self._give_up(f"{self._error}; the arm stays where it is: {response.message}")

    def _is_new(self, names: Sequence[str], view: OutlineView) -> bool:
        """Return whether one of these objects is new since the motions were created, or has moved."""
        now, before = _places(view), self._named
        return any(name in now and (name not in before or math.dist(now[name], before[name]) > NEAR) for name in names)

    def fail(self, message: str, view: OutlineView, *, go_home: bool = True) -> None:
        """End in ERROR, after a return home if the arm is elsewhere."""
        self.clear()
        self.status.failures += 1
        first, self._error = self._error, self._error or message
        self.status.message = self._error
        self.wait_timer.reset()
        if self.running is not None:  # the fingers may finish closing
            return
        if first:
            self._give_up(f"{first}; the arm stays where it is: {message}")
        elif self._is_home(view):
            self._give_up(message)
        else:
            self._recover(view)

    def _recover(self, view: OutlineView) -> None:
        """Move up and home, from wherever the arm is."""
        self.clear()
        up = self._up = self.retreat(view, self._excused, self.p.approach_clearance)
        up.state, up.cycle, up.needs_full_plan = "RETREATING", self._cycle, True
        self.queue += [up, self._segments.home(self._cycle), AwaitImage()]

    def _give_up(self, message: str) -> None:
        self._error, self._excused = "", None
        self.end("ERROR", message)

    # --- what its motions need -------------------------------------------------------------------------------

    def obstacles(self, move: Move, view: OutlineView) -> list[tuple[float, float]]:
        """Return none: the surroundings are only visible from home."""
        return []

    def time_limit(self, stage: Stage) -> float:
        """Time after which a stage is stopped [s]."""
        return self.p.overtime + (stage.seconds if isinstance(stage, Move) else 0.0)


def _places(view: OutlineView) -> dict[str, Place]:
    return {thing.id: place_of(thing.pose) for thing in view.scene.objects} if view.scene is not None else {}
