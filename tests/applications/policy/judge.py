"""Judges executed motions at every millisecond by pinocchio and coal, without the code that proves them."""

from __future__ import annotations

import coal
import numpy as np
import pinocchio as pin
from numpy.typing import NDArray

from applications.policy.interface import MotionState, ProvedMotion
from common.control.limiter import Limiter
from common.hardware.interface import Limits
from common.messages import CollisionObject, PlanningScene, Pose
from common.planning.robot_geometry import RobotGeometry
from common.robot.model import RobotModel

Array = NDArray[np.float64]

STEP = 1e-3  # [s]
MARGIN = 0.01  # [m]
REACH = 1.5  # [m] no point of arm and held object is farther from a joint's axis


def state_at(motion: ProvedMotion, time: float) -> MotionState:
    """Return the state of a motion's cubics at a time [s]."""
    k = int(np.clip(np.searchsorted(motion.times, time, side="right") - 1, 0, len(motion.times) - 2))
    h, t = motion.times[k + 1] - motion.times[k], time - motion.times[k]
    q, v, a = motion.positions[k], motion.velocities[k], motion.accelerations[k]
    j = (motion.accelerations[k + 1] - a) / h
    return MotionState(q + t * (v + t * (a / 2 + t * j / 6)), v + t * (a + t * j / 2), a + t * j)


def positions_at(motion: ProvedMotion, times: Array) -> Array:
    """Return positions (N, dof) of a motion's cubics through positions and velocities alone, as an executor may."""
    t = np.minimum(times, motion.times[-1])
    k = np.clip(np.searchsorted(motion.times, t, side="right") - 1, 0, len(motion.times) - 2)
    h = (motion.times[k + 1] - motion.times[k])[:, None]
    u = (t - motion.times[k])[:, None] / h
    q0, q1 = motion.positions[k], motion.positions[k + 1]
    v0, v1 = motion.velocities[k] * h, motion.velocities[k + 1] * h
    return q0 * (1 + 2 * u) * (1 - u)**2 + q1 * u**2 * (3 - 2 * u) + v0 * u * (1 - u)**2 - v1 * u**2 * (1 - u)


class Judge:
    """The links of a robot among solids, spheres (N, 4) [m] and an object held by the TCP's joint, for coal."""

    def __init__(
        self, robot: RobotModel, geometry: RobotGeometry, scene: PlanningScene, spheres: Array | None = None
    ) -> None:
        """Copy the geometry."""
        self._model, shapes = robot.model, geometry.geometry.copy()
        links = [i for i, item in enumerate(shapes.geometryObjects) if item.parentJoint]
        frame = robot.model.frames[robot.tcp_frame]
        others = [shapes.addGeometryObject(pin.GeometryObject(item.id, 0, 0, _placed(item.pose), _shape(item)))
                  for item in scene.objects]
        for number, (x, y, z, radius) in enumerate(() if spheres is None else spheres.tolist()):
            at = pin.SE3(np.eye(3), np.array([x, y, z]))
            others.append(shapes.addGeometryObject(
                pin.GeometryObject(f"point_{number}", 0, 0, at, coal.Sphere(radius))))
        held = [shapes.addGeometryObject(pin.GeometryObject(
            item.object.id, frame.parentJoint, robot.tcp_frame, frame.placement * _placed(item.object.pose),
            _shape(item.object))) for item in scene.attached]
        arm = [i for i in links if shapes.geometryObjects[i].parentJoint != frame.parentJoint]
        pairs = [(a, b) for a in links + held for b in others] + [(a, b) for a in arm for b in held]
        for a, b in pairs:
            shapes.addCollisionPair(pin.CollisionPair(a, b))
        self._shapes, self._data = shapes, robot.model.createData()
        self._managers = []
        for margin in (0.0, MARGIN):
            found = pin.GeometryData(shapes)
            for request in found.collisionRequests:
                request.security_margin = margin
            self._managers.append(
                (found, pin.BroadPhaseManager_DynamicAABBTreeCollisionManager(self._model, shapes, found)))

    def _touches(self, q: Array, level: int) -> bool:
        return bool(pin.computeCollisions(self._model, self._data, self._managers[level][1], q, True))

    def contacts(self, path: Array) -> int:
        """Return the number of positions (N, dof) [rad] at which anything touches.

        With MARGIN around everything free, no position is checked until a point could have moved so far.
        """
        i, touching = 0, 0
        while i < len(path):
            if self._touches(path[i], 1):
                touching += self._touches(path[i], 0)
                i += 1
                continue
            moved = REACH * np.abs(path[i : i + 200] - path[i]).sum(axis=1)
            i += int(np.argmax(moved > MARGIN)) or len(moved)
        return touching

    def tool(self, path: Array, frame: int) -> Array:
        """Return (N, 3) the positions of a frame [m], world."""
        found = []
        for q in path:
            pin.forwardKinematics(self._model, self._data, q)
            found.append(pin.updateFramePlacement(self._model, self._data, frame).translation.copy())
        return np.array(found)


def _placed(pose: Pose) -> pin.SE3:
    turn, at = pose.orientation, pose.position
    return pin.SE3(pin.Quaternion(turn.w, turn.x, turn.y, turn.z).matrix(), np.array([at.x, at.y, at.z]))


def _shape(item: CollisionObject) -> coal.CollisionGeometry:
    return {"box": coal.Box, "sphere": coal.Sphere, "cylinder": coal.Cylinder}[item.shape](*item.dimensions)


def shares(path: Array, limits: Limits) -> dict[str, float]:
    """Return the largest share of each limit in positions (N, dof) [rad] every STEP; 1 of position is a limit."""
    v = np.diff(path, axis=0) / STEP
    a, middle = np.diff(v, axis=0) / STEP, (limits.upper + limits.lower) / 2
    j = np.diff(a, axis=0) / STEP
    return {
        "position": float((np.abs(path - middle) / (limits.upper - middle)).max()),
        "velocity": float((np.abs(v) / limits.velocity).max(initial=0.0)),
        "acceleration": float((np.abs(a) / limits.acceleration).max(initial=0.0)),
        "jerk": float((np.abs(j) / limits.jerks).max(initial=0.0)),
    }


def braked_by_executor(limits: Limits, state: MotionState) -> Array:
    """Return positions (N, dof) every STEP of the limiter's fastest stop from a state."""
    limiter = Limiter(limits, state.positions, STEP)
    limiter.rest(state.positions, state.velocities)
    path = [state.positions]
    while len(path) < 5000 and (len(path) == 1 or not limiter.at_rest):
        path.append(limiter.brake(STEP)[0])
    return np.array(path)


def braked_by_joints(limits: Limits, state: MotionState) -> Array:
    """Return positions (N, dof) every STEP of a stop in which each joint brakes at its deceleration limit."""
    ends = np.abs(state.velocities) / limits.braking
    times = np.arange(0.0, float(ends.max()) + STEP, STEP)[:, None]
    t = np.minimum(times, ends)
    return np.asarray(state.positions + state.velocities * t - np.sign(state.velocities) * limits.braking * t**2 / 2)
