"""Base of tasks that move detected objects from one position to another.

A task of the user implements `choose` (which object is next) and `destination` (where the held object goes). This
module does the rest: grip a box by its faces, carry it, put it down, look again from home, continue with a held object
after a restart, and skip an object for a while after a failed attempt.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt
from pydantic import Field

from common import messages as m
from common.config import Grasp, Surroundings, Tunable
from common.robot.home import HOME_TOLERANCE
from common.robot.transforms import invert, matrix_to_pose, matrix_to_rpy, pose_to_matrix, rpy_to_matrix, tool_down
from common.tasks.decisions import TaskConfig
from common.tasks.engine import Task
from common.tasks.stages import MISSES, AwaitImage, Cycle, Grip, Move, Place, Stage, View, place_of

Array = npt.NDArray[np.float64]

DROP = 0.004  # [m] height above the support at which an object is released
SQUARE = 0.002  # [m] a box whose sides differ by less looks the same after a quarter turn
ASIDE = 0.08  # [m] free distance from every object to put something down


class HandlingStatus(m.TaskStatus):
    """Status of a task that moves objects."""

    state: Literal["IDLE", "GRASPING", "PLACING", "HOMING", "DONE", "ERROR"] = "IDLE"


class HandlingConfig(TaskConfig):
    """Parameters of grasping and placing; times are cell time unless they say wall."""

    world: Surroundings
    grasp: Grasp
    frame_timeout: Tunable[float] = Field(
        3.0, ge=0.1, le=60, description="an older picture starts no motion [s, wall time]"
    )
    settle: Tunable[float] = Field(1.0, ge=0, le=600, description="for so long all must look done before it is [s]")
    give_up: Tunable[float] = Field(20.0, gt=0, le=3600, description="wait for what is missing [s]")
    most_tries: Tunable[int] = Field(4, ge=1, le=100, description="for one object, before the task gives up")
    finger_clearance: Tunable[float] = Field(
        0.02, ge=0.01, le=0.5, description="how much wider than an object the fingers open before they grip it, and "
                                           "when they release it [m]"
    )
    width_tolerance: Tunable[float] = Field(
        0.01, gt=0, le=0.05, description="what is gripped may be so much wider or narrower than it was seen [m]"
    )


class Handling(Task[View]):
    """Moves objects one after the other and looks from home in between."""

    p: HandlingConfig
    ONE_DESTINATION: ClassVar = False  # for all objects, also for those whose kind a restarted planning scene lost

    def __init__(self, config: HandlingConfig, status: m.TaskStatus, prefix: str, speed: float = 1.0) -> None:
        """Start without an object; the arguments are those of `Task`."""
        super().__init__(config, status, prefix, speed)
        self._tries: Counter[str] = Counter()  # failed attempts by object id
        self._problem = ""  # reason of the last failed attempt
        self._home = config.robot.named_poses["home"]

    # --- implemented by the task ---------------------------------------------------------------------------------

    @abstractmethod
    def choose(self, view: View) -> None:
        """With empty gripper, at home and with a fresh image: call `bring`, `finish` or `lack`."""

    @abstractmethod
    def destination(self, thing: m.CollisionObject, view: View) -> m.Pose | None:
        """Return the pose of the held object's center in world; None puts it aside, to be seen first."""

    def opening(self, width: float | None) -> float:
        """Return the finger width before a grasp and at a release of an object of a width, None if unknown [m]."""
        most = self.gripper.max_width
        return most if width is None or self.gripper.cup is not None else min(width + self.p.finger_clearance, most)

    # --- used by the task ----------------------------------------------------------------------------------------

    def bring(self, things: Sequence[m.CollisionObject], view: View) -> None:
        """Queue the object with the fewest failed attempts; end with ERROR after too many."""
        thing = min(things, key=lambda one: self._tries[one.id])
        if self._tries[thing.id] >= self.p.most_tries:
            x, y, _ = place_of(thing.pose)
            self.end("ERROR", f"{thing.kind or thing.id} at ({x:.3f}, {y:.3f}): {self._problem}")
            return
        self.wait_timer.reset()
        self.queue += self._take(thing, view)

    def finish(self, view: View, least: float = 0.0, **figures: float) -> None:
        """End with DONE once this holds for the settling time, `least` [s]; `figures` go into the status."""
        if self.wait_timer.elapsed("done", view.scene_stamp) >= max(self.p.settle, least):
            self.status.figures.update(figures)
            self.end("DONE")

    def lack(self, what: str, view: View) -> None:
        """Report that something is missing, and end with ERROR after a while."""
        self.status.message = what
        if self.wait_timer.elapsed(what, view.scene_stamp) >= self.p.give_up:
            self.end("ERROR", what)

    def shown(self, view: View) -> bool:
        """Return whether the scene includes everything done so far, so that counting is valid."""
        return self.running is None and not view.holding and view.settled_stamp > self.images_after

    def container_of(self, thing: m.CollisionObject) -> str:
        """Return the id of the container that an object is in or above; empty for none."""
        x, y, _ = place_of(thing.pose)
        return next((name for name, box in self.p.world.containers.items()
                     if max(abs(x - box.x), abs(y - box.y)) < box.half_side), "")

    def inside(self, container: str, view: View) -> list[m.CollisionObject]:
        """Return the detected objects in a container."""
        return [thing for thing in view.objects("contained") if self.container_of(thing) == container]

    def room_in(self, container: str, thing: m.CollisionObject, view: View) -> m.Pose:
        """Return the pose above the corner of a container farthest from its contents, clear of its walls."""
        box, others = self.p.world.containers[container], [place_of(o.pose) for o in self.inside(container, view)]
        corners = [(box.x + dx, box.y + dy) for dx in (-box.slot_offset, box.slot_offset)
                   for dy in (-box.slot_offset, box.slot_offset)]
        x, y = max(corners, key=lambda at: min((math.dist(at, other[:2]) for other in others), default=math.inf))
        z = self.p.world.table_height + box.wall_height + height_of(thing)
        return m.Pose(position=m.Vector3(x=x, y=y, z=z))

    def on_top(self, thing: m.CollisionObject, below: m.CollisionObject) -> m.Pose:
        """Return the pose of an object on top of another, with the same orientation."""
        x, y, z = place_of(below.pose)
        return below.pose.model_copy(update={"position": m.Vector3(x=x, y=y, z=z + (height_of(below) + height_of(
            thing)) / 2)})

    # --- decisions -----------------------------------------------------------------------------------------------

    def decide(self, view: View) -> None:
        """Continue with a held object; with an empty gripper go home, look and choose."""
        assert view.gripper is not None and view.q is not None and view.scene is not None
        away = max(abs(a - b) for a, b in zip(view.q, self._home, strict=True)) > HOME_TOLERANCE
        if self.status.state == "DONE":  # no operator asked for more
            return
        if view.holding and view.gripper.outcome in MISSES:  # another object than intended
            self.queue += [Grip("open", "GRASPING", width=self.gripper.max_width), *self.back_off(view.released())]
        elif view.holding and not view.scene.header.stamp:  # the surroundings are only seen from home
            self.queue += [self.home(view), AwaitImage()] if away else []
        elif view.holding:
            if view.scene.attached:  # else the planning scene is not up to date yet
                held = view.scene.attached[0].object
                self.queue += self.put(held, held.pose, Cycle(held.id), view, view.gripper.width)
        elif away:
            self.queue += self.back_off(view)
        elif self.has_fresh_image(view):
            self.status.state, self.status.stage, self.status.subject, self.status.message = "IDLE", "", "", ""
            self.choose(view)

    def plan_failed(self, move: Move, response: m.PlanResponse, view: View) -> None:
        """Record the attempt: another gripper orientation or object may succeed."""
        if move.cycle is not None:
            self._note_try(move.cycle, response.message)
        super().plan_failed(move, response, view)

    def obstructed(self, stage: Stage, view: View, problem: str) -> None:
        """Record the attempt."""
        if stage.cycle is not None:
            self._note_try(stage.cycle, problem)
        super().obstructed(stage, view, problem)

    def missed(self, stage: Grip, view: View) -> None:
        """Record the attempt, then open, back off and look again."""
        if stage.cycle is not None:
            self._note_try(stage.cycle, stage.problem)
        super().missed(stage, view)

    def succeeded(self, stage: Stage, view: View) -> None:
        """Clear the failed attempts of an object that was put down."""
        if stage.name == "release" and stage.cycle is not None:
            del self._tries[stage.cycle.subject]

    def _note_try(self, cycle: Cycle, problem: str) -> None:
        self._tries[cycle.subject] += 1
        self._problem = problem

    def on_restart(self) -> None:
        """Allow objects with failed attempts again."""
        self._tries.clear()

    # --- stages --------------------------------------------------------------------------------------------------

    def _take(self, thing: m.CollisionObject, view: View) -> list[Stage]:
        """Open, move above the object, descend, close, lift; then the stages of `put`. A cup takes the top face."""
        x, y, z = place_of(thing.pose)
        ways = grasp_directions(thing, self.gripper.closing_axis, self.gripper.max_width)
        yaw, width = ways[self._tries[thing.id] % 2]
        low, cycle = self.p.grasp.height(z), Cycle(thing.id)
        if self.gripper.cup is not None:
            low, width = top_of(thing), self.gripper.held_width
        T_world_tcp = tool_down(x, y, low, yaw)
        held = matrix_to_pose(invert(T_world_tcp) @ pose_to_matrix(thing.pose))
        above = _raised(T_world_tcp, self.p.grasp.approach_clearance)
        return [
            Grip("open", "GRASPING", cycle, width=self.opening(width)),
            Move("pre-grasp", "GRASPING", cycle, goal=_at(above), needs_full_plan=True, needs_fresh_image=True),
            Move("descend", "GRASPING", cycle, goal=_at(T_world_tcp), straight=True, touches=self._fingers_on(thing)),
            Grip("close", "GRASPING", cycle, width=0.0, holds=True, effort=thing.grip_effort, mass=thing.mass,
                 expected_width=width, width_tolerance=self.p.width_tolerance),
            Move("lift", "GRASPING", cycle, goal=_at(above), straight=True, carries=True, attach=thing.id,
                 attach_pose=held),
            *self.put(thing, held, cycle, view, width),
        ]

    def put(self, thing: m.CollisionObject, held: m.Pose, cycle: Cycle, view: View,
            width: float | None) -> list[Stage]:
        """Move above the destination, lower, release, move up, go home and look."""
        goal = self.destination(thing, view) if thing.kind or self.ONE_DESTINATION else None
        goal = goal or self._aside(thing, view)
        tools = sorted(self._tools(thing, held, goal), key=lambda tool: abs(_yaw(tool)))
        tool = tools[self._tries[cycle.subject] % len(tools)]
        x, y, z = (float(value) for value in tool[:3, 3])
        down = tool_down(x, y, z + DROP, _yaw(tool))
        above = _raised(down, self.p.grasp.approach_clearance)
        expected = None if view.holding else held
        return [
            Move("across", "PLACING", cycle, goal=_at(above), carries=True, attach=thing.id, attach_pose=expected),
            Move("lower", "PLACING", cycle, goal=_at(down), straight=True, carries=True, attach=thing.id,
                 attach_pose=expected, touches=[(thing.id, other.id) for other in self._under(thing, goal, view)]),
            Grip("release", "PLACING", cycle, width=self.opening(width), carries=True, holds=False),
            Move("up", "HOMING", cycle, goal=_at(above), straight=True, touches=self._fingers_on(thing)),
            Move("home", "HOMING", cycle, goal=m.JointGoal(named="home")),
            AwaitImage(),
        ]

    def _under(self, thing: m.CollisionObject, goal: m.Pose, view: View) -> list[m.CollisionObject]:
        """Return the objects that may support an object at its destination."""
        x, y, z = place_of(goal)
        lowest = z - height_of(thing) / 2 + DROP
        return [other for other in view.objects("target") if other.id != thing.id and top_of(other) <= lowest
                and math.dist((x, y), place_of(other.pose)[:2]) < _reach(thing) + _reach(other)]

    def _tools(self, thing: m.CollisionObject, held: m.Pose, goal: m.Pose) -> Iterator[Array]:
        """Yield tool poses (4, 4) that place an object at its goal, for all rotations in which it looks the same."""
        T_tcp_object = pose_to_matrix(held)
        if T_tcp_object[2, 2] > 0 and thing.shape == "box":  # upside down, as after a handover: it looks the same
            T_tcp_object[:3, :3] = T_tcp_object[:3, :3] @ rpy_to_matrix(math.pi, 0.0, 0.0)
        turns = 4 if thing.shape != "box" or abs(thing.dimensions[0] - thing.dimensions[1]) < SQUARE else 2
        for turn in range(turns):
            turned = pose_to_matrix(goal)
            turned[:3, :3] = turned[:3, :3] @ rpy_to_matrix(0.0, 0.0, 2 * math.pi * turn / turns)
            yield turned @ invert(T_tcp_object)

    def _aside(self, thing: m.CollisionObject, view: View) -> m.Pose:
        """Return the free position on the table nearest to the tool, within easy reach."""
        x, y, _ = view.tool
        far = min(max(math.hypot(x, y), 0.40), 0.55)  # [m] from the base axis
        others = [place_of(o.pose) for role in ("target", "contained") for o in view.objects(role)]
        others += [(box.x, box.y, 0.0) for box in self.p.world.containers.values()]
        turns = sorted((math.radians(5 * k) for k in range(-12, 13)), key=lambda turn: abs(turn - math.atan2(y, x)))
        places = [(far * math.cos(turn), far * math.sin(turn)) for turn in turns]
        at = next((p for p in places if all(math.dist(p, o[:2]) > ASIDE + self._half(o) for o in others)), places[0])
        height = height_of(thing) if thing.kind else max(thing.dimensions)  # of an undetected one the width is known
        return m.Pose(position=m.Vector3(x=at[0], y=at[1], z=self.p.world.table_height + height / 2))

    def _half(self, place: Place) -> float:
        """Half side of the container centered at a position [m]; 0 where there is none."""
        return next((box.half_side for box in self.p.world.containers.values() if (box.x, box.y) == place[:2]), 0.0)

    def _fingers_on(self, thing: m.CollisionObject) -> list[tuple[str, str]]:
        return [(link, thing.id) for link in self.gripper.links]


def grasp_directions(
    thing: m.CollisionObject, closing_axis: str, max_width: float
) -> list[tuple[float, float | None]]:
    """Return tool yaws [rad] and finger widths [m] for two opposite faces of a box, and for the other two.

    Args:
        thing: upright, to be gripped from above.
        closing_axis: of the tool centre point, along which the fingers close.
        max_width: of the open gripper [m]: ways that do not fit are left out.
    """
    turn = math.pi / 2 if closing_axis == "x" else 0.0
    if thing.shape != "box":
        width = 2 * thing.dimensions[0]
        return [(turn, width), (turn + math.pi / 2, width)]
    yaw = _yaw(pose_to_matrix(thing.pose))
    ways = [(math.remainder(yaw + turn + quarter, math.pi), width)
            for quarter, width in ((0.0, thing.dimensions[1]), (math.pi / 2, thing.dimensions[0]))]
    ways.sort(key=lambda way: abs(way[0] - turn))
    fitting = [way for way in ways if way[1] < max_width] or ways
    return [fitting[0], fitting[-1]]


def height_of(thing: m.CollisionObject) -> float:
    """Height of an upright object [m]."""
    return 2 * thing.dimensions[0] if thing.shape == "sphere" else thing.dimensions[-1]


def top_of(thing: m.CollisionObject) -> float:
    """Height of the top of an upright object, in world [m]."""
    return thing.pose.position.z + height_of(thing) / 2


def _reach(thing: m.CollisionObject) -> float:
    """Radius of the circle around an object, seen from above [m]."""
    return math.hypot(*thing.dimensions[:2]) / 2 if thing.shape == "box" else thing.dimensions[0]


def _yaw(T_world_thing: Array) -> float:
    return matrix_to_rpy(T_world_thing[:3, :3])[2]


def _raised(T_world_tcp: Array, height: float) -> Array:
    raised = T_world_tcp.copy()
    raised[2, 3] += height
    return raised


def _at(T_world_tcp: Array) -> m.PoseGoal:
    return m.PoseGoal(pose=matrix_to_pose(T_world_tcp))
