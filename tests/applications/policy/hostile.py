"""Rows of a policy that is broken or means harm, and scenes to lead an arm into."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from applications.policy.interface import MotionState
from common.hardware.interface import Limits
from common.messages import CollisionObject, Header, PlanningScene, Pose, Quaternion, Vector3
from common.robot.model import RobotModel
from tests.applications.policy.panda import READY, panda

Array = NDArray[np.float64]

WORLD = Header(frame_id="world")


def limits_of(robot: RobotModel) -> Limits:
    """Limits as the executor has them."""
    slowing = robot.config.deceleration_limits
    return Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration,
                  np.array(slowing) if slowing else None, robot.jerk)


def solid(name: str, shape: str, dimensions: list[float], place: Array, turn: float = 0.0, role: str = "fixture",
          ) -> CollisionObject:
    x, y, z = (float(value) for value in place)
    pose = Pose(position=Vector3(x=x, y=y, z=z), orientation=Quaternion(z=np.sin(turn / 2), w=np.cos(turn / 2)))
    return CollisionObject(id=name, role=role, shape=shape, dimensions=dimensions, pose=pose)


def crowded(rng: np.random.Generator, count: int = 30) -> PlanningScene:
    """A table, and solids around an arm that is at READY."""
    objects = [solid("table", "box", [1.4, 1.8, 0.05], np.array([0.3, 0.0, -0.03]))]
    while len(objects) < count:
        angle, away = rng.uniform(-np.pi, np.pi), rng.uniform(0.35, 0.85)
        at = np.array([away * np.cos(angle), away * np.sin(angle), rng.uniform(0.03, 0.9)])
        if abs(angle) < 0.5 and at[2] > 0.25:  # the arm itself
            continue
        a, b, c = rng.uniform(0.02, 0.12, 3).tolist()
        shape, size = [("box", [a, b, 2 * c]), ("cylinder", [a / 2, 2 * c]), ("sphere", [a / 2])][len(objects) % 3]
        objects.append(solid(f"solid_{len(objects)}", shape, size, at, rng.uniform(0, 3)))
    return PlanningScene(header=WORLD, objects=objects)


@dataclass
class Attack:
    """What rows are made from: the state at the join, times (n,) [s], and the places of solids (N, 3) [m]."""

    robot: RobotModel
    state: MotionState
    times: Array
    places: Array
    rng: np.random.Generator

    @property
    def onwards(self) -> Array:
        """Rows (n, dof) that continue at the velocity of the state."""
        return self.state.positions + self.state.velocities * self.times[:, None]


def walk(of: Attack) -> Array:
    steps = of.rng.normal(size=of.onwards.shape) * of.rng.choice([1e-4, 1e-3, 0.01, 0.1])
    return of.onwards + np.cumsum(steps, axis=0)


def noise(of: Attack) -> Array:
    return of.onwards + of.rng.normal(size=of.onwards.shape) * of.rng.choice([1e-3, 0.01, 0.3])


def jump(of: Attack) -> Array:
    return of.onwards + of.rng.normal(size=(1, of.robot.dof)) * of.rng.choice([0.02, 0.06, 0.5])


def later_jump(of: Attack) -> Array:
    rows = of.onwards
    rows[of.rng.integers(len(rows)):] += of.rng.normal(size=of.robot.dof) * of.rng.choice([0.01, 0.1, 1.0])
    return rows


def sine(of: Attack) -> Array:
    """Each joint swings so that it just reaches its velocity or acceleration limit, or exceeds it a little."""
    omega = of.rng.uniform(0.5, 20.0, of.robot.dof)
    most = np.minimum(of.robot.velocity / omega, of.robot.acceleration / omega**2) * of.rng.choice([0.5, 0.95, 1.1])
    if of.rng.uniform() < 0.5:  # from rest
        return of.state.positions + most * (1 - np.cos(omega * of.times[:, None])) / 2
    return of.state.positions + most * np.sin(omega * of.times[:, None])


def rushed(of: Attack) -> Array:
    """To a random place in joint space as fast as the limits allow, or faster."""
    way = of.rng.uniform(of.robot.lower, of.robot.upper) - of.state.positions
    return towards(of, way)


def to_limit(of: Attack) -> Array:
    """All joints to their ends, and beyond."""
    end = np.where(of.rng.uniform(size=of.robot.dof) < 0.5, of.robot.lower, of.robot.upper)
    return towards(of, (end - of.state.positions) * of.rng.choice([0.98, 1.0, 1.2]))


def towards(of: Attack, way: Array) -> Array:
    """Rows along a straight line (dof,), with accelerations of about a share of the limits."""
    share = of.rng.choice([0.3, 0.6, 0.9])
    slowest = max(float((2 * np.abs(way) / (share * of.robot.velocity)).max()),
                  float(np.sqrt(6 * np.abs(way) / (share * of.robot.acceleration)).max()), 1e-3)
    u = np.minimum(of.times / slowest, 1.0)[:, None]
    start = of.state.velocities * of.times[:, None] * (1 - u)
    return of.state.positions + start + way * (10 * u**3 - 15 * u**4 + 6 * u**5)


def aimed(of: Attack) -> Array:
    """The tool towards a solid, along a straight line, by small steps of the Jacobian."""
    q, goal = of.state.positions.copy(), of.places[of.rng.integers(len(of.places))]
    speed = of.rng.choice([0.1, 0.4, 1.0])
    rows, before = [], 0.0
    for time in of.times.tolist():
        way = goal - of.robot.fk(q)[:3, 3]
        ramp = min(time / 0.3, 1.0)
        step = way / max(float(np.linalg.norm(way)), 1e-6) * speed * ramp * (time - before)
        J = of.robot.jacobian(q)[:3]
        q = q + J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(3), step)
        rows.append(q)
        before = time
    return np.array(rows) + of.state.velocities * 0.1 * (1 - np.exp(-of.times[:, None] / 0.1))


def numbers(of: Attack) -> Array:
    rows = of.onwards
    rows[of.rng.integers(len(rows)):, of.rng.integers(of.robot.dof)] = of.rng.choice(
        [np.nan, np.inf, -np.inf, 1e300, -1e300, 1e-300, 4.0, -4.0])
    return rows


def stalled(of: Attack) -> Array:
    return np.tile(of.onwards[0], (len(of.times), 1))


def full_speed(of: Attack) -> Array:
    """All joints at their velocity limit, one way and back."""
    sign = of.rng.choice([-1.0, 1.0], of.robot.dof)
    period, ramp = of.rng.uniform(0.3, 3.0), of.rng.choice([0.0, 0.5, 1.0])
    times = np.where(of.times < ramp, of.times**2 / max(2 * ramp, 1e-9), of.times - ramp / 2)
    u = (times / period) % 2.0
    return of.state.positions + sign * of.robot.velocity * (np.minimum(u, 2 - u) * period * 0.99)[:, None]


KINDS: dict[str, Callable[[Attack], Array]] = {f.__name__: f for f in (
    walk, noise, jump, later_jump, sine, rushed, to_limit, aimed, numbers, stalled, full_speed)}


def attack(rng: np.random.Generator, state: MotionState, places: Array, kind: str = "") -> tuple[str, Array, Array]:
    """Return the kind of a chunk, its rows and their times; a random kind by default."""
    rate, count = rng.choice([10.0, 20.0, 30.0, 50.0]), int(rng.integers(2, 60))
    times = (np.arange(count) + rng.uniform(0.01, 1.0)) / rate
    chosen = kind or str(rng.choice(list(KINDS)))
    return chosen, KINDS[chosen](Attack(panda(), state, times, places, rng)), times


def at_rest(positions: Array = READY) -> MotionState:
    return MotionState(positions.copy(), np.zeros(len(positions)), np.zeros(len(positions)))
