"""An executor whose arm follows its set-points at once and feels a wall: the double of an arm with a force sensor."""

from typing import Any

import numpy as np

from common import messages as m
from common.config import load_cell
from common.control.executor import Executor
from common.control.force_requests import ForceLimits
from common.control.force_sensing import ForceSensing
from common.hardware.interface import Limits
from common.robot.model import RobotModel

PERIOD = 0.01  # [s]


class WallArm:
    """A Panda without delay; below `wall` [m] of the TCP the surroundings push it up with `stiffness` [N/m]."""

    gripper = None
    known_payload = (0.0, 0.0, 0.0, 0.0)

    def __init__(self, robot: RobotModel, q: np.ndarray) -> None:
        self.robot, self.q, self.dq = robot, q.copy(), 0 * q
        self.wall, self.stiffness, self.lost, self.extra = -1.0, 2e4, False, np.zeros(3)

    def read(self, now: float) -> tuple[np.ndarray, np.ndarray]:
        return self.q.copy(), self.dq.copy()

    def write(self, positions: np.ndarray, velocities: np.ndarray, now: float) -> None:
        self.q, self.dq = positions.copy(), velocities.copy()

    def wrench(self) -> np.ndarray | None:
        """The push at the TCP, as the flange feels it along its axes."""
        if self.lost:
            return None
        T = self.robot.fk(self.q)
        force = np.array([0.0, 0.0, self.stiffness * max(self.wall - T[2, 3], 0.0)]) + self.extra
        R = T[:3, :3] @ self.robot.T_flange_tcp[:3, :3].T
        return np.concatenate([R.T @ force, np.cross(self.robot.T_flange_tcp[:3, 3], R.T @ force)])

    def close(self) -> None:
        """Nothing."""


class WallRig:
    """Time, requests and reports of an executor over such an arm, which starts at home."""

    def __init__(self, wall: float | None = None, limits: tuple[float, float] = (60.0, 10.0),
                 sensor: bool = True) -> None:
        config = load_cell("panda").robot
        self.robot = RobotModel.load(config)
        start = self.robot.named("home")
        joints = Limits(tuple(self.robot.joint_names), self.robot.lower, self.robot.upper, self.robot.velocity,
                        self.robot.acceleration, None, self.robot.jerk)
        self.arm = WallArm(self.robot, start)
        if wall is not None:
            self.arm.wall = self.height - wall
        sensing = ForceSensing(self.arm, self.robot, config.tcp_link) if sensor else None
        self.executor = Executor(self.arm, joints, start, kinematics=self.robot, force=sensing, period=PERIOD,
                                 force_limits=ForceLimits(*limits))
        self.executor.force_motions.task_present = True
        self.now, self.count = 1.0, 0
        self.run(0.05)

    @property
    def height(self) -> float:
        """z of the TCP [m]."""
        return float(self.robot.fk(self.arm.q)[2, 3])

    @property
    def status(self) -> m.MotionStatus:
        return self.executor.arm.status

    def step(self) -> None:
        self.now += PERIOD
        self.executor.cycle(m.Header(stamp=round(self.now * 1e9), frame_id="world"))

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD)):
            self.step()

    def line(self, distance: float, direction: Any = (0.0, 0.0, -1.0)) -> m.JointTrajectory:
        """A straight line of the tool, by small steps of its Jacobian."""
        q = self.executor.arm.set_point.copy()
        path, T = [q.copy()], self.robot.fk(q)
        steps = 20
        for k in range(1, steps + 1):
            for _ in range(3):
                at = self.robot.fk(q)
                turn = 0.5 * sum(np.cross(at[:3, i], T[:3, i]) for i in range(3))
                off = T[:3, 3] + np.asarray(direction) * distance * k / steps - at[:3, 3]
                q = q + np.linalg.pinv(self.robot.jacobian(q)) @ np.concatenate([off, turn])
            path.append(q.copy())
        times = np.linspace(0.0, 2.0, steps + 1)
        velocities = np.gradient(np.array(path), times, axis=0)
        velocities[[0, -1]] = 0.0
        return m.JointTrajectory(joint_names=self.robot.joint_names, points=[
            m.JointTrajectoryPoint(time_from_start=t, positions=p.tolist(), velocities=v.tolist(),
                                   accelerations=[0.0] * len(p))
            for t, p, v in zip(times.tolist(), path, velocities, strict=True)])

    def request(self, kind: str = "until", **fields: Any) -> m.ForceMotion:
        self.count += 1
        distance = fields.get("max_distance", 0.05)
        direction = fields.pop("direction", (0.0, 0.0, -1.0))
        line = fields.pop("trajectory", None) or self.line(distance + 1e-3, direction)
        return m.ForceMotion.model_validate({
            "id": f"f{self.count}", "kind": kind, "trajectory": line,
            "direction": dict(zip("xyz", direction, strict=True)), **fields})

    def send(self, kind: str = "until", **fields: Any) -> m.MotionStatus:
        return self.executor.move_by_force(self.request(kind, **fields), self.now)

    def finish(self, seconds: float = 60.0) -> m.MotionStatus:
        end = self.now + seconds
        while self.executor.arm.goal and self.now < end:
            self.step()
        return self.status
