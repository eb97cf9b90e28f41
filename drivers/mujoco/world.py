"""Ground truth with physics: objects fall, roll, are pushed, are held by friction, and slip.

Edits, names and appearance follow the kinematic world: its bodies are reused, and it decides where an edit puts them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from functools import partial

import mujoco
import numpy as np
from numpy.typing import NDArray

from common.config import GripperConfig, ObjectConfig, World
from common.errors import ConfigError, Refused
from common.hardware.interface import Hardware, Limits, Vector
from common.messages import Header, WorldEdit, WorldObjects
from common.robot.model import RobotModel
from common.robot.transforms import invert, transform
from common.sim.bodies import Body, WorldEvents
from common.sim.conveyors import Belts
from common.sim.interface import GraspTolerances, Numbers, ObjectSnapshot
from common.sim.kinematic import KinematicWorld
from common.sim.suction import NOTHING, seal_problem
from drivers.mujoco.arm import PhysicsArm, tune
from drivers.mujoco.belts import PhysicsBelts
from drivers.mujoco.model import (
    REST_SPEED,
    CellModel,
    Contacts,
    ObjectStates,
    build_model,
    pose_changed,
    prefix,
    snap_upright,
)
from drivers.mujoco.scene import DEFAULT_MASS, ROBOT, TIMESTEP, SceneObject

Array = NDArray[np.float64]

MAX_CATCH_UP = 2.0  # [s] of delay; time of a longer one is skipped
PUBLISH_INTERVAL = 0.05  # [s] between published changes while objects move
SLIP_TIME = 0.5  # [s] without finger contact after a drop; extended until they are clear
QUIET = 1e-6  # [m] or quaternion entries: no motion since the last update
ASLEEP = 1e-3  # [m/s] or [rad/s]: smaller velocities are restored as zero


class PhysicsWorld(WorldEvents):
    """The objects and the arms.

    Attributes:
        version: increases with every published change.
        belts: carry what lies on them.
    """

    def __init__(
        self, world: World, objects: Sequence[ObjectConfig], tolerances: GraspTolerances,
        gripper: GripperConfig | None,
    ) -> None:
        """Place all objects; motion starts with `hardware`.

        Raises:
            ConfigError: an object cannot lie at its position.
        """
        super().__init__()
        self._config, self.belts = world, Belts(world.conveyors)
        self._kinematic = KinematicWorld(world, objects, tolerances, gripper)
        self._first_masses = {obj.id: obj.mass for obj in objects}
        self._masses = dict(self._first_masses)
        self._first_frictions = {obj.id: obj.friction for obj in objects}
        self._frictions = dict(self._first_frictions)
        self._states = ObjectStates(world)
        self._removed: set[str] = set()  # objects reported as removed
        self._slippery: dict[str, float] = {}  # end of the slip time [s]
        self._time: float | None = None
        self._published_at = -math.inf
        self._robots: dict[str, RobotModel] = {}  # by arm
        self._arms: dict[str, PhysicsArm] = {}
        self._cell: CellModel | None = None
        self._data: mujoco.MjData
        self._touching: tuple[set[str], set[str], set[str]] | None = None

    # --- the arms ---

    def hardware(self, robot: RobotModel, limits: Limits, start: Vector) -> Hardware:
        """Return the only arm in this world, at rest at `start` (dof,) [rad], with open fingers.

        Raises:
            ConfigError: the robot cannot be simulated.
        """
        return self.arm("", robot, limits, start)

    def arm(self, name: str, robot: RobotModel, limits: Limits, start: Vector) -> Hardware:
        """Return one more arm in this world: see `common.sim.interface.PhysicalWorldOfArms`."""
        self._robots[name] = robot
        self._arms[name] = arm = PhysicsArm(name, robot, start, self.advance, partial(self._seal, name))
        self._build()
        cell, data = self.simulation
        cell.set_joints(data, [prefix(name) + joint for joint in robot.joint_names], start)
        if arm.fingers is not None and robot.config.gripper is not None:
            arm.fingers.place(robot.config.gripper.max_width)
        mujoco.mj_forward(cell.model, data)
        return arm

    @property
    def simulation(self) -> tuple[CellModel, mujoco.MjData]:
        """The compiled model and its state."""
        if self._cell is None:
            raise RuntimeError("the world has no arm yet: call `hardware` first")
        return self._cell, self._data

    def _build(self) -> None:
        """Build the model; joints and objects of the previous model keep position and velocity."""
        before = None if self._cell is None else (self._cell, self._data)
        bodies = self._kinematic.bodies
        objects = [SceneObject(name, body.solid, body.color, self._masses.get(name, DEFAULT_MASS),
                               self._frictions.get(name)) for name, body in bodies.items()]
        cell = build_model(self._robots, self._config, objects)
        tune(cell, self._robots)
        data = mujoco.MjData(cell.model)
        data.qpos[:] = cell.start
        for name, body in bodies.items():
            cell.set_object(data, name, body.T)
        if before is not None:
            _copy(*before, cell, data)
        mujoco.mj_forward(cell.model, data)
        self._cell, self._data, self._contacts = cell, data, Contacts(cell, self._robots)
        self._drives = PhysicsBelts(self._config, cell, self.belts)
        for name in self._slippery:
            self._set_robot_contact(name, False)
        self._qpos = np.array([i for at in cell.objects.values() for i in range(at.qpos, at.qpos + 7)], int)
        self._touching, self._last_qpos = None, np.full(len(self._qpos), np.inf)
        for arm in self._arms.values():
            arm.attach(cell, data)

    # --- time ---

    def advance(self, now: float) -> None:
        """Advance to a time [s]; do nothing if the world is there already, as another arm was read."""
        (cell, data), arms = self.simulation, list(self._arms.values())
        if self._time is None or now - self._time > MAX_CATCH_UP:
            self._time = now
        steps = math.floor((now - self._time) / TIMESTEP + 1e-6)
        for _ in range(steps):
            for arm in arms:
                arm.drive(self._time)
            self._drives.drive(data, self._time + TIMESTEP)
            mujoco.mj_step(cell.model, data)
            for arm in arms:
                arm.measure()
            self._time += TIMESTEP
        if steps > 0:
            for arm in arms:
                arm.sense(self._time)
            self._update(self._time)
            self._drives.update(data, self._kinematic.bodies)

    def _update(self, now: float) -> None:
        """Update bodies and events from physics."""
        cell, data = self.simulation
        for name in [name for name, until in self._slippery.items() if now >= until and not self._within_robot(name)]:
            del self._slippery[name]
            self._set_robot_contact(name, True)
        contacts = self._contacts.update(data)
        contacts[0].update(arm.cup.held for arm in self._arms.values() if arm.cup is not None and arm.cup.held)
        bodies = self._kinematic.bodies
        self._states.update(now, contacts, bodies)
        qpos = data.qpos[self._qpos]
        is_quiet = np.abs(qpos - self._last_qpos).max(initial=0.0) < QUIET
        if contacts == self._touching and not self._removed and is_quiet:
            return
        # Objects on belts move all the time: an older position would be published with the time of a newer one.
        self._touching, publish = contacts, bool(self.belts) or now - self._published_at >= PUBLISH_INTERVAL
        if publish:  # else the next update publishes it
            self._last_qpos = qpos
        for name, body in bodies.items():
            T = snap_upright(cell.pose_of(data, name))
            state, container = self._states.state_of(body, T, name in contacts[2])
            unchanged = (state, container) == (body.state, body.container)
            if unchanged and not (publish and pose_changed(T, body.T)):
                self._publish_events(body)
                continue
            body.T, body.state, body.container = T, state, container
            body.slot = body.rest = body.grip = None
            body.changed()
            self.version += 1
            self._published_at = now
            self._publish_events(body)

    def _seal(self, arm: str) -> tuple[str, str]:
        """Return the object that the suction cup of an arm seals on, else why it seals on none."""
        (cell, data), config = self.simulation, self._robots[arm].config
        gripper, link = config.gripper, data.body(prefix(arm) + config.tcp_link)
        assert gripper is not None and gripper.cup is not None
        T_tcp_world, reason = invert(transform(link.xmat.reshape(3, 3), link.xpos)), NOTHING
        for name, body in self._kinematic.bodies.items():
            problem = seal_problem(gripper.cup, body.solid, T_tcp_world @ cell.pose_of(data, name))
            if not problem and name not in self._slippery:
                return name, ""
            reason = f"{name}: {problem}" if problem and problem != NOTHING else reason
        return "", reason

    def _publish_events(self, body: Body) -> None:
        if body.state == "held" and body.name not in self._removed:
            self._removed.add(body.name)
            self._add_event("remove", body)
        elif body.state in ("table", "contained") and body.name in self._removed and (
                self._speed(body.name) < REST_SPEED):
            self._removed.discard(body.name)
            self._add_event("add", body)

    def _speed(self, name: str) -> float:
        cell, data = self.simulation
        at = cell.objects[name].dof
        return float(np.linalg.norm(data.qvel[at: at + 3]))

    # --- queries ---

    @property
    def ids(self) -> list[str]:
        """Ids of all objects."""
        return self._kinematic.ids

    @property
    def layout(self) -> dict[str, Numbers]:
        """Initial positions (x, y, z) [m] by id."""
        return self._kinematic.layout

    @property
    def held(self) -> str:
        """Id of the held object, or an empty string."""
        return self._kinematic.held

    def objects(self, header: Header) -> WorldObjects:
        """State of all objects; those in state "elsewhere" lie on the floor."""
        return self._kinematic.objects(header)

    # --- snapshot ---

    def snapshot(self) -> dict[str, ObjectSnapshot]:
        """Complete state with velocities, for `restore`."""
        cell, data = self.simulation
        found = {}
        for name, body in self._kinematic.bodies.items():
            snapshot, at = body.snapshot(), cell.objects[name]
            speeds = data.qvel[at.dof: at.dof + 6]
            details = {**snapshot.details, "mass": self._masses.get(name, DEFAULT_MASS),
                       "friction": self._frictions.get(name),
                       "slippery": name in self._slippery,
                       "qpos": data.qpos[at.qpos: at.qpos + 7].tolist(),
                       "qvel": speeds.tolist() if np.abs(speeds).max() > ASLEEP else [0.0] * 6}
            found[name] = snapshot.model_copy(update={"details": details})
        return found

    def restore(self, objects: Mapping[str, ObjectSnapshot]) -> None:
        """Restore a state with velocities; a held object is at rest, like the restarted arm."""
        self._kinematic.restore(objects)
        self._masses = {name: float(snapshot.details.get("mass", DEFAULT_MASS)) for name, snapshot in objects.items()}
        self._frictions = {name: snapshot.details.get("friction") for name, snapshot in objects.items()}
        self._removed = {name for name, body in self._kinematic.bodies.items() if body.state in ("held", "falling")}
        self._slippery = {name: -math.inf for name, snapshot in objects.items() if snapshot.details.get("slippery")}
        self._build()
        cell, data = self.simulation
        for name, snapshot in objects.items():
            if name in cell.objects and "qpos" in snapshot.details:
                address = cell.objects[name]
                data.qpos[address.qpos: address.qpos + 7] = snapshot.details["qpos"]
                held = snapshot.details.get("state") == "held"
                data.qvel[address.dof: address.dof + 6] = [0.0] * 6 if held else snapshot.details["qvel"]
            if name in cell.objects and snapshot.details.get("state") == "elsewhere":
                self._states.on_floor(name)
        mujoco.mj_forward(cell.model, data)
        self.version += 1

    # --- edits ---

    def edit(self, request: WorldEdit, now: float) -> str:
        """Change the world as an operator requests: see `common.sim.interface`."""
        if request.op == "drop":
            return self._slip(request.id)
        before = set(self._kinematic.ids)
        name = self._kinematic.edit(request, now)
        updates = self._kinematic.take_events()
        changed = self._kinematic.ids if request.op == "reset" else [name] if name in self._kinematic.bodies else []
        if request.op == "reset":
            self._masses, self._frictions = dict(self._first_masses), dict(self._first_frictions)
        elif request.op == "add":
            template = request.like or self._default_template
            self._masses[name] = request.mass or self._first_masses.get(template, DEFAULT_MASS)
            self._frictions[name] = self._first_frictions.get(template)
        if request.op == "reset" or before != set(self._kinematic.ids):
            try:
                self._build()
            except ConfigError as error:  # caused by the added object: the rest was built before
                self._kinematic.edit(WorldEdit(op="remove", id=name), now)
                self._kinematic.take_events()
                self._masses.pop(name, None)
                raise Refused("no_size", f"{name}: {error}") from None
        self._events += [each for each in updates if request.op == "reset" or each.data.partition(":")[2] == name]
        cell, data = self.simulation
        for each in changed:
            address, body = cell.objects[each], self._kinematic.bodies[each]
            body.rest = None
            cell.set_object(data, each, body.T)
            data.qvel[address.dof: address.dof + 6] = 0.0
            self._states.forget(each)
            self._removed.discard(each)
        mujoco.mj_forward(cell.model, data)
        self.version += 1
        return name

    @property
    def _default_template(self) -> str:
        return next(iter(self._first_masses), "")

    def _slip(self, name: str) -> str:
        held = name or self.held
        if held not in self._kinematic.bodies or self._kinematic.bodies[held].state != "held":
            raise Refused("not_held", f"{name or 'nothing'} is {'not ' if name else ''}between the fingers")
        self._set_robot_contact(held, False)
        self._slippery[held] = (self._time or 0.0) + SLIP_TIME
        self._states.forget(held)
        return held

    def _set_robot_contact(self, name: str, by_robot: bool) -> None:
        cell, _ = self.simulation
        if name in cell.objects:
            geoms = cell.model.geom_bodyid == cell.objects[name].body
            affinity = cell.model.geom_conaffinity[geoms]
            cell.model.geom_conaffinity[geoms] = affinity | ROBOT if by_robot else affinity & ~ROBOT

    def _within_robot(self, name: str) -> bool:
        """Whether the robot overlaps an object: restoring contact would fling them apart."""
        cell, data = self.simulation
        if name not in cell.objects:
            return False
        of_object = np.flatnonzero(cell.model.geom_bodyid == cell.objects[name].body)
        of_robot = np.flatnonzero(cell.model.geom_contype & ROBOT)
        return any(mujoco.mj_geomDistance(cell.model, data, int(one), int(other), 0.0, None) < 0.0
                   for one in of_object for other in of_robot)


def _copy(old: CellModel, source: mujoco.MjData, new: CellModel, data: mujoco.MjData) -> None:
    """Copy positions and velocities of joints and objects from one model to another."""
    for name, qpos in old.joints.items():
        data.qpos[new.joints[name]] = source.qpos[qpos]
        data.qvel[new.dofs[name]] = source.qvel[old.dofs[name]]
    for name, was in old.objects.items():
        if name in new.objects:
            now = new.objects[name]
            data.qpos[now.qpos: now.qpos + 7] = source.qpos[was.qpos: was.qpos + 7]
            data.qvel[now.dof: now.dof + 6] = source.qvel[was.dof: was.dof + 6]
    for name, actuator in old.actuators.items():
        data.ctrl[new.actuators[name]] = source.ctrl[actuator]
