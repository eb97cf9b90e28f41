"""A parallel gripper that floats in MuJoCo without an arm: whether a grasp holds.

    bench = Bench(objects, poses, tray, shape)
    bench.settle()
    outcome = bench.attempt(T_world_tcp, opening, Conditions(friction=0.4, force=20.0))

The hand is a free body, welded to a mocap body that follows the path: down along the approach, close, lift, shake. The
fingers slide, tied by an equality, and close at `CLOSING` with a limited force: fingers whose target jumps squeeze
light objects out. The friction of the pads is that of every pair they touch (geom priority). With friction 0.02 almost
nothing may be held: if it is, contact is modeled wrongly (tests/applications/sorting/test_floating.py).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol

import mujoco
import numpy as np
import numpy.typing as npt

from applications.sorting.learning.tray_model import (
    FINGERS,
    HAND,
    HIDDEN_GROUP,
    TOOL_GROUP,
    HandShape,
    add_gripper,
    add_object,
    add_tray,
    new_spec,
    pose_to_qpos,
    qpos_to_pose,
)
from common.config import Container

Array = npt.NDArray[np.float64]
Result = Literal["held", "empty", "slipped", "two", "knocked out"]

STEPS = 2  # physics steps between two set-points
APPROACH = 0.08  # [m] straight line before the grasp
DESCENT = 0.30  # [m/s]
CLOSING = 0.10  # [m/s] of the width
SQUEEZE = 0.10  # [s] at full force before the lift
CLOSE_TIMEOUT = 0.8  # [s] after the fingers could have closed
PRESSING, STILL = 0.98, 0.003  # fraction of the force, and speed [m/s], of fingers that press on something
FULL_FORCE = -0.02  # [m] target of a finger that presses with its full force at any width
LIFT, LIFT_TIME = 0.25, 0.8  # [m], [s]
SHAKE, SHAKE_TIME, SHAKE_RATE, SHAKE_TILT = 0.015, 0.7, 3.0, 0.15  # [m], [s], [Hz], [rad]
LIFTED = 0.12  # [m] an object that rose this far was lifted
CLOSED = 1e-3  # [m] width of fingers with nothing between them
AT_REST = 0.01  # [m/s, and rad/s by 10]
PARKED = 3.0  # [m] height of the hand while objects settle


class PhysicalObject(Protocol):
    """What the bench needs of an object: convex pieces in its frame, and its mass."""

    @property
    def parts(self) -> Sequence[Array]: ...  # noqa: D102  # triangles (n, 3, 3) [m] of each piece

    @property
    def color(self) -> tuple[float, float, float]: ...  # noqa: D102

    @property
    def mass(self) -> float: ...  # noqa: D102  # [kg]

    @property
    def friction(self) -> float: ...  # noqa: D102  # against all but the pads


@dataclass(frozen=True)
class Conditions:
    """What an attempt is made with.

    Attributes:
        friction: of the pads against any object.
        force: of each finger [N].
        error: (4, 4) actual pose of the tool in its commanded frame.
    """

    friction: float = 0.4
    force: float = 20.0
    error: Array = field(default_factory=lambda: np.eye(4))


@dataclass(frozen=True)
class Outcome:
    """Result of an attempt: `held` means one object in the fingers after the shake, and no other left the tray.

    Attributes:
        result: held, or why not.
        lifted: indices of objects that were lifted.
        width: of the fingers at the end [m].
        lost: number of objects that left the tray and are not held.
    """

    result: Result
    lifted: tuple[int, ...]
    width: float
    lost: int

    @property
    def held(self) -> bool:
        """Whether the attempt succeeded."""
        return self.result == "held"


class Bench:
    """Objects in a tray below a floating gripper. Each attempt starts from the same state of the objects."""

    def __init__(
        self, objects: Sequence[PhysicalObject], poses: Sequence[Array], tray: Container, shape: HandShape,
        table: float = 0.0,
    ) -> None:
        """Build the model with objects at their poses.

        Args:
            objects: in the tray.
            poses: (4, 4) of each in world.
            tray: on the table.
            shape: of the gripper.
            table: z of the table [m].

        Raises:
            ValueError: MuJoCo cannot simulate an object, such as one of flat pieces.
        """
        self._tray, self._shape, self._table = tray, shape, table
        spec = new_spec()
        add_tray(spec, tray, table)
        for number, thing in enumerate(objects):
            add_object(spec, number, thing.parts, thing.color, thing.friction, getattr(thing, "surface", None))
        add_gripper(spec, shape)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        self.count = len(objects)
        self._find_addresses()
        self._set_masses([thing.mass for thing in objects])
        for at, T in zip(self._qpos, poses, strict=True):
            self.data.qpos[at: at + 7] = pose_to_qpos(T)
        self._park()
        mujoco.mj_forward(self.model, self.data)
        self._save()

    def _find_addresses(self) -> None:
        model, joints = self.model, [f"object:{number}" for number in range(self.count)]
        self._bodies = np.array([model.body(name).id for name in joints], np.int64)
        self._qpos = [int(model.joint(name).qposadr[0]) for name in joints]
        self._dofs = [int(model.joint(name).dofadr[0]) for name in joints]
        self._hand = int(model.joint(HAND).qposadr[0])
        self._fingers = [int(model.joint(name).qposadr[0]) for name in FINGERS]
        self._finger_dofs = [int(model.joint(name).dofadr[0]) for name in FINGERS]
        self._finger_bodies = [int(model.body(name).id) for name in FINGERS]
        self._pads = np.flatnonzero(np.isin(model.geom_bodyid, self._finger_bodies))
        self._mocap = int(model.body_mocapid[model.body("target").id])

    def _set_masses(self, masses: Sequence[float]) -> None:
        model = self.model
        for body, mass in zip(self._bodies, masses, strict=True):
            factor = mass / model.body_mass[body]
            model.body_mass[body] *= factor
            model.body_inertia[body] *= factor
        mujoco.mj_setConst(model, mujoco.MjData(model))

    def _save(self) -> None:
        self._start = self.data.qpos.copy(), self.data.qvel.copy()

    def _park(self) -> None:
        T = np.eye(4)
        T[:3, 3] = self._tray.x, self._tray.y, PARKED
        self._place(T, self._shape.max_width)

    def _place(self, T: Array, width: float) -> None:
        """Put the hand at a pose (4, 4) with its fingers at a width [m], at rest."""
        self.data.qpos[self._hand: self._hand + 7] = pose_to_qpos(T)
        self.data.qpos[self._fingers] = width / 2
        self.data.ctrl[:] = width / 2
        self._aim(T)

    def _aim(self, T: Array) -> None:
        at = pose_to_qpos(T)
        self.data.mocap_pos[self._mocap], self.data.mocap_quat[self._mocap] = at[:3], at[3:]

    def settle(self, seconds: float = 2.0) -> bool:
        """Let the objects come to rest for up to a time [s]; return whether all are at rest in the tray."""
        still = 0
        for _ in range(round(seconds / self.model.opt.timestep / 10)):
            mujoco.mj_step(self.model, self.data, 10)
            speeds = np.array([self.data.qvel[dof: dof + 6] * (1, 1, 1, 0.1, 0.1, 0.1) for dof in self._dofs])
            still = still + 1 if np.abs(speeds).max(initial=0.0) < AT_REST else 0
            if still >= 5:
                break
        self._save()
        return still > 0 and bool(self._inside(self.positions()).all())

    def positions(self) -> Array:
        """(n, 3) centers of mass of the objects in world [m]."""
        return np.asarray(self.data.xipos[self._bodies])

    def poses(self) -> list[Array]:
        """(4, 4) pose of each object in world."""
        return [qpos_to_pose(self.data.qpos[at: at + 7]) for at in self._qpos]

    def _inside(self, at: Array) -> npt.NDArray[np.bool_]:
        off = np.abs(at[:, :2] - (self._tray.x, self._tray.y)).max(axis=1)
        return np.asarray((off < self._tray.half_side) & (at[:, 2] > self._table))

    def cast(self, origin: Array, directions: Array) -> tuple[Array, npt.NDArray[np.int32]]:
        """Cast rays at the objects and the tray, without the gripper.

        Args:
            origin: (3,) in world [m].
            directions: (n, 3) in world; of any length.

        Returns:
            (n,) distances in units of the directions, inf without a hit; and (n,) indices of geoms, -1 without a hit.
        """
        self._reset()
        count = len(directions)
        geoms, distances = np.full(count, -1, np.int32), np.empty(count)
        groups = np.ones(6, np.uint8)
        groups[[TOOL_GROUP, HIDDEN_GROUP]] = 0
        mujoco.mj_multiRay(self.model, self.data, origin, np.ascontiguousarray(directions, np.float64).ravel(), groups,
                           True, -1, geoms, distances, None, count, 1e3)
        return np.where(geoms >= 0, distances, np.inf), geoms

    def _reset(self) -> None:
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:], self.data.qvel[:] = self._start
        self._park()
        mujoco.mj_forward(self.model, self.data)

    def attempt(
        self, T: Array, opening: float, conditions: Conditions, watch: Callable[[mujoco.MjData], None] | None = None
    ) -> Outcome:
        """Try a grasp and return its outcome.

        Args:
            T: (4, 4) commanded pose of the tool center point in world; z is the approach.
            opening: width of the fingers on the way [m].
            conditions: friction, force and pose error.
            watch: called after each set-point, for pictures.
        """
        self._reset()
        model = self.model
        model.geom_friction[self._pads, 0] = conditions.friction
        model.actuator_forcerange[:] = -conditions.force, conditions.force
        before = self.positions()[:, 2].copy()
        goal = T @ conditions.error @ self._shape.T_tcp_closing
        opening = min(opening, self._shape.max_width)
        self._place(_retreated(goal, APPROACH), opening)
        mujoco.mj_forward(model, self.data)
        self._descend(goal, watch)
        width = self._close(opening, watch)
        self._lift_and_shake(goal, watch)
        return self._judge(before, width)

    def _step(self, watch: Callable[[mujoco.MjData], None] | None) -> None:
        mujoco.mj_step(self.model, self.data, STEPS)
        if watch is not None:
            watch(self.data)

    def _descend(self, goal: Array, watch: Any) -> None:
        tick = STEPS * self.model.opt.timestep
        steps = round(APPROACH / DESCENT / tick)
        for step in range(1, steps + 1):
            self._aim(_retreated(goal, APPROACH * (1 - step / steps)))
            self._step(watch)

    def _close(self, opening: float, watch: Any) -> float:
        """Close by a ramp until the fingers press on something, or each other, for `SQUEEZE`; return the width."""
        tick = STEPS * self.model.opt.timestep
        target, pressed = opening / 2, 0.0
        enough = PRESSING * self.model.actuator_forcerange[0, 1]
        for _ in range(round((opening / CLOSING + CLOSE_TIMEOUT) / tick)):
            target = max(target - CLOSING / 2 * tick, FULL_FORCE)
            self.data.ctrl[:] = target
            self._step(watch)
            still = np.abs(self.data.qvel[self._finger_dofs]).max() < STILL
            pressed = pressed + tick if still and np.abs(self.data.actuator_force).max() >= enough else 0.0
            if pressed >= SQUEEZE:
                break
        self.data.ctrl[:] = FULL_FORCE
        return self._width()

    def _lift_and_shake(self, goal: Array, watch: Any) -> None:
        tick = STEPS * self.model.opt.timestep
        for step in range(round((LIFT_TIME + SHAKE_TIME) / tick)):
            t = (step + 1) * tick
            T = goal.copy()
            T[2, 3] += LIFT * (1 - math.cos(math.pi * min(t / LIFT_TIME, 1.0))) / 2
            if t > LIFT_TIME:
                T = _shaken(T, t - LIFT_TIME)
            self._aim(T)
            self._step(watch)

    def _width(self) -> float:
        return 2 * float(self.data.qpos[self._fingers].mean())

    def _judge(self, before: Array, closed: float) -> Outcome:
        """Return the outcome by the heights (n,) before [m] and the width of the closed fingers [m]."""
        at = self.positions()
        rose = at[:, 2] - before > LIFTED
        lifted = tuple(np.flatnonzero(rose).tolist())
        lost = int((~rose & ~self._inside(at)).sum())
        result: Result = "held" if len(lifted) == 1 else "two"
        if lost:
            result = "knocked out"
        elif not lifted:
            result = "empty" if closed < CLOSED else "slipped"
        return Outcome(result, lifted, self._width(), lost)


def _retreated(T: Array, distance: float) -> Array:
    back = T.copy()
    back[:3, 3] -= distance * T[:3, 2]
    return back


def _shaken(T: Array, t: float) -> Array:
    """Return the pose shifted along two axes and tilted about a third, `t` [s] after the start of the shake."""
    swell = math.sin(math.pi * min(t / SHAKE_TIME, 1.0))
    angle = SHAKE_TILT * swell * math.sin(2 * math.pi * SHAKE_RATE * 0.7 * t)
    c, s = math.cos(angle), math.sin(angle)
    moved = T.copy()
    moved[:3, :3] = T[:3, :3] @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    moved[0, 3] += SHAKE * swell * math.sin(2 * math.pi * SHAKE_RATE * t)
    moved[1, 3] += SHAKE * swell * math.sin(2 * math.pi * SHAKE_RATE * 1.3 * t)
    return moved
