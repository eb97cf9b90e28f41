"""A policy without learning: finds the red ball by its color in an image, and picks it up.

`policy` has the interface of a learned one: what it knows of the ball comes from the newest image. It has no memory, so
it continues from any state: above the ball, at it, with the ball in the fingers, or where an operator moved the arm.
"""

import math
from functools import cache

import cv2
import numpy as np

from applications.policy.interface import Chunk, Observation
from common.config import load_cell
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_quaternion, tool_down

CELL = "policy_panda"
RATE, ROWS = 20.0, 20  # [Hz], one second
SPEED, ACCELERATION = 0.20, 0.40  # [m/s], [m/s^2] of the tool center point
DESCENT = 0.12  # [m/s] next to the ball
TURN, TURN_ACCELERATION = 1.2, 3.0  # [rad/s], [rad/s^2] of the tool
TURNED = 0.1  # [rad] missing rotation that allows the descent
BALL = 0.03  # [m] height of its center: the height of the grasp
ABOVE, LIFTED = 0.15, 0.20  # [m] height before the descent, and with the ball
NEAREST = 0.29  # [m] from the base axis: nearer, the elbow meets its limit
ALIGNED, REACHED = 0.006, 0.003  # [m] horizontal error that allows the descent; distance that allows to close
OPEN, CLOSED, NARROW = 0.08, 0.0, 0.07  # [m] width; below NARROW the fingers may hold a ball
LEAST = 6.0  # [px] of red that make a ball, in a picture of 96 x 96
TICKS = 10  # of the integration in a row


def policy(observation: Observation) -> Chunk:
    """Return tool poses for the next second. Uses the first image, which shows the complete view of the camera."""
    if not observation.images:
        raise ValueError("no camera in the observation")
    robot, _ = _cell()
    ball = find_ball(next(iter(observation.images.values())))
    committed = [robot.fk(q) for q in observation.committed[:ROWS]]
    T = committed[-1] if committed else observation.tcp
    if len(committed) > 1:
        turned = cv2.Rodrigues(T[:3, :3] @ committed[-2][:3, :3].T)[0].ravel()
        twist = RATE * np.array([*(T[:3, 3] - committed[-2][:3, 3]), *turned])
    else:
        twist = robot.jacobian(observation.positions) @ observation.velocities
    rows = [*committed, *_ahead(T, twist, ball, observation.gripper, ROWS - len(committed))]
    width = _width(T[:3, 3], ball, observation.gripper)
    poses = [(*T[:3, 3], *matrix_to_quaternion(T[:3, :3])) for T in rows]
    return Chunk(observation.stamp, RATE, "tcp", np.array(poses), np.full(len(poses), width))


def find_ball(image: np.ndarray) -> np.ndarray | None:
    """Return (3,) the center of the ball in world [m], or None if there is no red in an RGB image (h, w, 3)."""
    height, width = image.shape[:2]
    r, g, b = np.moveaxis(image.astype(np.float32), 2, 0)
    red = np.clip(r - np.maximum(g, b) - 120, 0, None) / 97  # more than the orange of the box
    if red.sum() < LEAST * width * height / 96**2:
        return None
    _, camera = _cell()
    u = (red.sum(axis=0) @ (np.arange(width) + 0.5) / red.sum()) * camera.width / width - 0.5
    v = (red.sum(axis=1) @ (np.arange(height) + 0.5) / red.sum()) * camera.height / height - 0.5
    return np.array([*camera.on_plane((u, v), BALL), BALL])


def _ahead(T: np.ndarray, twist: np.ndarray, ball: np.ndarray | None, gripper: float, rows: int) -> list[np.ndarray]:
    """Return poses (4, 4) of the next rows, from T_world_tcp with a twist (6,) [m/s], [rad/s], along axes of world."""
    T, dt, found = T.copy(), 1 / (RATE * TICKS), []
    speed, rate = float(np.linalg.norm(twist[:3])), float(np.linalg.norm(twist[3:]))
    for _ in range(rows):
        for _ in range(TICKS):
            turn = _missing_turn(T, ball)
            angle = float(np.linalg.norm(turn))
            goal, fastest = _goal(T[:3, 3], ball, gripper, angle)
            away = goal - T[:3, 3]
            distance = float(np.linalg.norm(away))
            speed = min(speed + ACCELERATION * dt, fastest, float(np.sqrt(2 * ACCELERATION * distance)))
            T[:3, 3] += away * min(speed * dt / max(distance, 1e-9), 1.0)
            T[:2, 3] *= max(NEAREST / max(np.linalg.norm(T[:2, 3]), 1e-9), 1.0)
            rate = min(rate + TURN_ACCELERATION * dt, TURN, float(np.sqrt(2 * TURN_ACCELERATION * angle)))
            T[:3, :3] = cv2.Rodrigues(turn * min(rate * dt / max(angle, 1e-9), 1.0))[0] @ T[:3, :3]
        found.append(T.copy())
    return found


def _missing_turn(T: np.ndarray, ball: np.ndarray | None) -> np.ndarray:
    """Return the rotation vector (3,) [rad], world, to a tool that points down and away from the base, as at home."""
    x, y = T[:2, 3] if ball is None else ball[:2]
    return cv2.Rodrigues(tool_down(0, 0, 0, math.atan2(y, x))[:3, :3] @ T[:3, :3].T)[0].ravel()


def _goal(position: np.ndarray, ball: np.ndarray | None, gripper: float, turn: float) -> tuple[np.ndarray, float]:
    """Return where the tool goes next (3,) [m] and its highest speed [m/s]; `turn` is its missing rotation [rad]."""
    if ball is None:  # in the fingers, or not in view
        return np.array([*position[:2], LIFTED if gripper < NARROW else position[2]]), SPEED
    if gripper < NARROW and not _at(position, ball):  # open the fingers first
        return position, SPEED
    if np.linalg.norm(position[:2] - ball[:2]) > ALIGNED or turn > TURNED:
        return np.array([*ball[:2], ABOVE]), SPEED
    return ball, DESCENT


def _width(position: np.ndarray, ball: np.ndarray | None, gripper: float) -> float:
    """Return the width of the fingers [m]: closed at the ball, and with it."""
    closed = gripper < NARROW if ball is None else _at(position, ball)
    return CLOSED if closed else OPEN


def _at(position: np.ndarray, ball: np.ndarray) -> bool:
    return bool(np.linalg.norm(position - ball) < REACHED + ALIGNED)


@cache
def _cell() -> tuple[RobotModel, Pinhole]:
    cell = load_cell(CELL)
    return RobotModel.load(cell.robot), Pinhole.from_config(cell.world.camera)
