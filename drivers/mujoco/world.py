"""The truth as physics has it: objects fall, roll, are pushed, held by friction, and slip.

Where a person may put something, what objects are called and look like is as in the kinematic world, whose bodies are
used for that: what is asked of it is where an edit puts them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import GripperConfig, ObjectConfig, World
from common.errors import ConfigError, Refused
from common.hardware.interface import Hardware, Limits, Vector
from common.messages import Header, WorldEdit, WorldObjects
from common.robot.model import RobotModel
from common.sim.bodies import Body
from common.sim.interface import GraspTolerances, Numbers, StandingObject
from common.sim.kinematic import KinematicWorld
from common.sim.news import News
from drivers.mujoco.arm import PhysicsArm, tune
from drivers.mujoco.model import CellModel, build_model
from drivers.mujoco.object_states import RESTS, Contacts, Watch, pose_changed, snap_upright
from drivers.mujoco.scene import ROBOT, TIMESTEP, USUAL_MASS, SceneObject

Array = NDArray[np.float64]

MOST_CAUGHT_UP = 2.0  # [s] of a hold-up; what is longer, the world has stood still
TOLD = 0.05  # [s] between changes that are told of while something moves
SLIPPERY = 0.5  # [s] fingers do not touch what a person lets slip, and not before they are clear of it
QUIET = 1e-6  # [m] or of a quaternion: nothing has moved since the last look
ASLEEP = 1e-3  # [m/s] or [rad/s]: velocities below are not saved over a restart


class PhysicsWorld(News):
    """The objects and the arm among them.

    Attributes:
        version: grows whenever something has changed that is worth telling.
    """

    def __init__(
        self, world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances,
        gripper: GripperConfig | None,
    ) -> None:
        """Lay everything out; it begins to move with `hardware`.

        Raises:
            ConfigError: an object cannot lie where it is to, or the gripper is a suction cup.
        """
        if gripper is not None and gripper.cup is not None:
            raise ConfigError("world.simulator", "mujoco", "has fingers only: with a suction cup use kinematic")
        super().__init__()
        self._config = world
        self._paper = KinematicWorld(world, objects, tolerances, gripper)
        self._first_masses = {thing.id: thing.mass for thing in objects}
        self._masses = dict(self._first_masses)
        self._watch = Watch(world)
        self._taken: set[str] = set()  # what "remove" was said of
        self._slippery: dict[str, float] = {}  # until when
        self._time: float | None = None
        self._told_at = -math.inf
        self._cell: CellModel | None = None
        self._data: mujoco.MjData
        self._touching: tuple[set[str], set[str], set[str]] | None = None

    # --- the arm ---

    def hardware(self, robot: RobotModel, limits: Limits, start: Vector) -> Hardware:
        """The arm in this world, at rest at `start` (dof,) [rad], with open fingers.

        Raises:
            ConfigError: the robot cannot be simulated.
        """
        self._robot = robot
        self._arm = PhysicsArm(robot, start, self.advance)
        self._build()
        cell, data = self._built
        cell.set_joints(data, robot.joint_names, start)
        if self._arm.fingers is not None and robot.config.gripper is not None:
            self._arm.fingers.place(robot.config.gripper.max_width)
        mujoco.mj_forward(cell.model, data)
        return self._arm

    @property
    def _built(self) -> tuple[CellModel, mujoco.MjData]:
        if self._cell is None:
            raise RuntimeError("the world stands still without the arm: call `hardware` first")
        return self._cell, self._data

    def _build(self) -> None:
        """Make the model of what there is; joints and objects that were there are where they were, as fast."""
        before = None if self._cell is None else (self._cell, self._data)
        bodies = self._paper.bodies
        things = [SceneObject(name, body.solid, body.color, self._masses.get(name, USUAL_MASS))
                  for name, body in bodies.items()]
        cell = build_model(self._robot, self._config, things)
        tune(cell, self._robot)
        data = mujoco.MjData(cell.model)
        data.qpos[:] = cell.start
        for name, body in bodies.items():
            cell.set_object(data, name, body.T)
        if before is not None:
            _copy(*before, cell, data)
        mujoco.mj_forward(cell.model, data)
        self._cell, self._data, self._contacts = cell, data, Contacts(cell, self._robot)
        for name in self._slippery:
            self._touchable(name, False)
        self._qpos = np.array([at for place in cell.things.values() for at in range(place.qpos, place.qpos + 7)], int)
        self._touching, self._looked_at = None, np.full(len(self._qpos), np.inf)
        self._arm.attach(cell, data)

    # --- time ---

    def advance(self, now: float) -> None:
        """Let the world go on to a time [s]."""
        cell, data = self._built
        if self._time is None or now - self._time > MOST_CAUGHT_UP:
            self._time = now
        steps = math.floor((now - self._time) / TIMESTEP + 1e-6)
        for _ in range(steps):
            self._arm.drive(self._time)
            mujoco.mj_step(cell.model, data)
            self._time += TIMESTEP
        if steps > 0:
            self._arm.sense(self._time)
            self._look(self._time)

    def _look(self, now: float) -> None:
        """Take note of what has moved."""
        cell, data = self._built
        for name in [name for name, until in self._slippery.items() if now >= until and not self._within_robot(name)]:
            del self._slippery[name]
            self._touchable(name, True)
        contacts = self._contacts.look(data)
        bodies = self._paper.bodies
        self._watch.look(now, contacts, bodies)
        places = data.qpos[self._qpos]
        if contacts == self._touching and not self._taken and np.abs(places - self._looked_at).max(initial=0.0) < QUIET:
            return
        self._touching, due = contacts, now - self._told_at >= TOLD
        if due:  # else the next look tells of it
            self._looked_at = places
        for name, body in bodies.items():
            T = snap_upright(cell.pose_of(data, name))
            state, container = self._watch.state_of(body, T, name in contacts[2])
            same = (state, container) == (body.state, body.container)
            if same and not (due and pose_changed(T, body.T)):
                self._news_of(body)
                continue
            body.T, body.state, body.container = T, state, container
            body.slot = body.rest = body.grip = None
            body.changed()
            self.version += 1
            self._told_at = now
            self._news_of(body)

    def _news_of(self, body: Body) -> None:
        if body.state == "held" and body.name not in self._taken:
            self._taken.add(body.name)
            self._say("remove", body)
        elif body.state in ("table", "contained") and body.name in self._taken and self._speed(body.name) < RESTS:
            self._taken.discard(body.name)
            self._say("add", body)

    def _speed(self, name: str) -> float:
        cell, data = self._built
        at = cell.things[name].dof
        return float(np.linalg.norm(data.qvel[at: at + 3]))

    # --- what there is ---

    @property
    def ids(self) -> list[str]:
        """What is in it."""
        return self._paper.ids

    @property
    def layout(self) -> dict[str, Numbers]:
        """Where everything was at first, (x, y, z) [m] by id."""
        return self._paper.layout

    @property
    def held(self) -> str:
        """The id of what is between the fingers, or an empty string."""
        return self._paper.held

    def objects(self, header: Header) -> WorldObjects:
        """Where everything is; what is "elsewhere" lies on the floor."""
        return self._paper.objects(header)


    # --- over a restart ---

    def standing(self) -> dict[str, StandingObject]:
        """Everything as it is and moves at this moment, for `restore`."""
        cell, data = self._built
        found = {}
        for name, body in self._paper.bodies.items():
            saved, at = body.standing(), cell.things[name]
            speeds = data.qvel[at.dof: at.dof + 6]
            details = {**saved.details, "mass": self._masses.get(name, USUAL_MASS), "slippery": name in self._slippery,
                       "qpos": data.qpos[at.qpos: at.qpos + 7].tolist(),
                       "qvel": speeds.tolist() if np.abs(speeds).max() > ASLEEP else [0.0] * 6}
            found[name] = saved.model_copy(update={"details": details})
        return found

    def restore(self, objects: Mapping[str, StandingObject]) -> None:
        """Put everything where it was, as fast as it was; what is held stands still, as the arm does that begins."""
        self._paper.restore(objects)
        self._masses = {name: float(saved.details.get("mass", USUAL_MASS)) for name, saved in objects.items()}
        self._taken = {name for name, body in self._paper.bodies.items() if body.state in ("held", "falling")}
        self._slippery = {name: -math.inf for name, saved in objects.items() if saved.details.get("slippery")}
        self._build()
        cell, data = self._built
        for name, saved in objects.items():
            if name in cell.things and "qpos" in saved.details:
                place = cell.things[name]
                data.qpos[place.qpos: place.qpos + 7] = saved.details["qpos"]
                held = saved.details.get("state") == "held"
                data.qvel[place.dof: place.dof + 6] = [0.0] * 6 if held else saved.details["qvel"]
            if name in cell.things and saved.details.get("state") == "elsewhere":
                self._watch.on_floor(name)
        mujoco.mj_forward(cell.model, data)
        self.version += 1

    # --- edits ---

    def edit(self, request: WorldEdit, now: float) -> str:
        """Change the world as a person asks: see `common.sim.interface`."""
        if request.op == "drop":
            return self._slip(request.id)
        before = set(self._paper.ids)
        name = self._paper.edit(request, now)
        updates = self._paper.take_events()
        changed = self._paper.ids if request.op == "reset" else [name] if name in self._paper.bodies else []
        if request.op == "reset":
            self._masses = dict(self._first_masses)
        elif request.op == "add":
            self._masses[name] = request.mass or self._first_masses.get(request.like or self._usual, USUAL_MASS)
        if request.op == "reset" or before != set(self._paper.ids):
            try:
                self._build()
            except ConfigError as error:  # of what was added: all else was built before
                self._paper.edit(WorldEdit(op="remove", id=name), now)
                self._paper.take_events()
                self._masses.pop(name, None)
                raise Refused("no_size", f"{name}: {error}") from None
        self._events += [each for each in updates if request.op == "reset" or each.data.partition(":")[2] == name]
        cell, data = self._built
        for each in changed:
            place, body = cell.things[each], self._paper.bodies[each]
            body.rest = None
            cell.set_object(data, each, body.T)
            data.qvel[place.dof: place.dof + 6] = 0.0
            self._watch.forget(each)
            self._taken.discard(each)
        mujoco.mj_forward(cell.model, data)
        self.version += 1
        return name

    @property
    def _usual(self) -> str:
        return next(iter(self._first_masses), "")

    def _slip(self, name: str) -> str:
        held = self.held
        if not held or name not in ("", held):
            raise Refused("not_held", f"{name or 'nothing'} is {'not ' if name else ''}between the fingers")
        self._touchable(held, False)
        self._slippery[held] = (self._time or 0.0) + SLIPPERY
        self._watch.forget(held)
        return held

    def _touchable(self, name: str, by_robot: bool) -> None:
        cell, _ = self._built
        if name in cell.things:
            geoms = cell.model.geom_bodyid == cell.things[name].body
            affinity = cell.model.geom_conaffinity[geoms]
            cell.model.geom_conaffinity[geoms] = affinity | ROBOT if by_robot else affinity & ~ROBOT


    def _within_robot(self, name: str) -> bool:
        """Whether part of the robot is where a thing is: they would be flung apart if they touched from now on."""
        cell, data = self._built
        if name not in cell.things:
            return False
        of_thing = np.flatnonzero(cell.model.geom_bodyid == cell.things[name].body)
        of_robot = np.flatnonzero(cell.model.geom_contype & ROBOT)
        return any(mujoco.mj_geomDistance(cell.model, data, int(one), int(other), 0.0, None) < 0.0
                   for one in of_thing for other in of_robot)


def _copy(old: CellModel, source: mujoco.MjData, new: CellModel, data: mujoco.MjData) -> None:
    """Bring positions and velocities of what is in both models from one to the other."""
    for name, qpos in old.joints.items():
        data.qpos[new.joints[name]] = source.qpos[qpos]
        data.qvel[new.dofs[name]] = source.qvel[old.dofs[name]]
    for name, was in old.things.items():
        if name in new.things:
            now = new.things[name]
            data.qpos[now.qpos: now.qpos + 7] = source.qpos[was.qpos: was.qpos + 7]
            data.qvel[now.dof: now.dof + 6] = source.qvel[was.dof: was.dof + 6]
    for name, actuator in old.actuators.items():
        data.ctrl[new.actuators[name]] = source.ctrl[actuator]
