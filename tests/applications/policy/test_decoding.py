"""Chunks of every kind become joint targets; what has a wrong shape or cannot be reached is named."""

from contextlib import suppress
from dataclasses import replace

import numpy as np
import pytest
from pinocchio import log3

from applications.policy.decoding import decode
from applications.policy.interface import Chunk, PolicyFailed
from common.config.loading import load_robot
from common.robot.model import RobotModel
from common.robot.transforms import matrix_to_quaternion
from tests.applications.policy.panda import READY, STAMP, observation, panda

SEEN = observation()


def chunk(kind, values, gripper=None, **changed):
    return replace(Chunk(STAMP, 20.0, kind, values, gripper), **changed)


def path(n=20, robot=None):
    """Joint positions (n, 7) near READY, and their TCP poses."""
    rows = READY + np.linspace(0.01, 0.2, n)[:, None] * np.array([1, 0.5, -0.5, 0.3, 0.2, -0.4, 0.6])
    return rows, np.array([panda().fk(q) for q in rows])


def as_tcp(poses):
    return np.array([[*T[:3, 3], *matrix_to_quaternion(T[:3, :3])] for T in poses])


def test_joints_and_steps_are_added_and_nan_passes_on():
    rows, _ = path()
    rows[3, 2] = np.nan
    decoded, widths = decode(chunk("joints", rows, np.full(20, 0.04)), SEEN, panda())
    np.testing.assert_array_equal(decoded, rows)
    np.testing.assert_array_equal(widths, np.full(20, 0.04))
    decoded, widths = decode(chunk("joint_steps", rows - READY), SEEN, panda())
    np.testing.assert_allclose(decoded, rows)
    assert widths is None


@pytest.mark.parametrize("steps", [False, True])
def test_tcp_rows_reach_their_poses_and_are_continuous(steps):
    _, poses = path()
    if steps:
        values = np.array([[*(T[:3, 3] - SEEN.tcp[:3, 3]), *log3(T[:3, :3] @ SEEN.tcp[:3, :3].T)] for T in poses])
    else:
        values = as_tcp(poses)
        values[::2, 3:] *= -1.03  # both signs are one rotation; its length is not exact
    decoded, _ = decode(chunk("tcp_steps" if steps else "tcp", values), SEEN, panda())
    for q, T in zip(decoded, poses, strict=True):
        np.testing.assert_allclose(panda().fk(q), T, atol=2e-4)
    assert np.abs(np.diff(np.vstack([READY, decoded]), axis=0)).max() < 0.1
    assert (decoded >= panda().lower).all() and (decoded <= panda().upper).all()


def test_tcp_poses_are_in_world_for_an_arm_elsewhere():
    config = load_robot("panda").model_copy(update={"base_position": (0.4, -0.3, 0.2), "base_rpy": (0.0, 0.0, 1.0)})
    robot = RobotModel.load(config)
    T = robot.fk(READY + 0.05)
    decoded, _ = decode(chunk("tcp", as_tcp([T])), replace(SEEN, tcp=robot.fk(READY)), robot)
    np.testing.assert_allclose(robot.fk(decoded[0]), T, atol=2e-4)


HERE = as_tcp([SEEN.tcp])[0]
ROW = np.zeros((1, 7))
FAR = HERE + np.array([2.0, 0, 0, 0, 0, 0, 0])
TURNED = as_tcp([panda().fk(READY + np.array([0, 0, 0, 0, 0, 0, 2.0]))])[0]
WRONG = [
    ("columns", chunk("joints", np.zeros((5, 6))), r"joints: must be of shape \(n, 7\), not \(5, 6\)"),
    ("one row", chunk("joints", np.zeros(7)), r"must be of shape \(n, 7\), not \(7,\)"),
    ("batch", chunk("tcp", np.zeros((1, 5, 7))), r"must be of shape \(n, 7\), not \(1, 5, 7\)"),
    ("empty", chunk("joints", np.zeros((0, 7))), "must have 1 to 1000 rows, not 0"),
    ("endless", chunk("joints", np.zeros((1001, 7))), "not 1001"),
    ("endless view", chunk("joints", np.broadcast_to(0.0, (10**12, 7))), "not 1000000000000"),
    ("objects", chunk("joints", np.array([[None] * 7])), "of numbers, not an array of object"),
    ("text", chunk("joints", np.array([["1"] * 7])), "not an array of <U1"),
    ("complex", chunk("joints", np.zeros((1, 7), complex)), "not an array of complex128"),
    ("ragged", chunk("joints", [[0.0] * 7, [0.0]]), "its rows differ in length"),
    ("long double", chunk("joints", np.zeros((1, 7), np.longdouble)), "of numbers, not an array of"),
    ("no array", chunk("joints", None), "not NoneType"),
    ("kind", chunk("velocities", ROW), "kind 'velocities'; choices: joints, joint_steps, tcp, tcp_steps"),
    ("array as kind", chunk(np.array(["joints", "tcp"]), ROW), "choices: joints"),
    ("array as stamp", chunk("joints", ROW, stamp=np.array([STAMP, STAMP])), "that of its observation is"),
    ("array as rate", chunk("joints", ROW, rate=np.array([20.0, 20.0])), "rate of a chunk"),
    ("no rate", chunk("joints", ROW, rate=0.0), "rate of a chunk: 0.0"),
    ("NaN rate", chunk("joints", ROW, rate=np.nan), "rate of a chunk: nan"),
    ("text rate", chunk("joints", ROW, rate="fast"), "rate of a chunk: fast"),
    ("old", chunk("joints", ROW, stamp=STAMP - 5), f"{STAMP - 5}; that of its observation is {STAMP}"),
    ("widths", chunk("joints", ROW, np.zeros(2)), r"gripper: must be of shape \(1,\), not \(2,\)"),
    ("NaN width", chunk("joints", ROW, np.array([np.nan])), "gripper: row 0 is not finite"),
    ("NaN pose", chunk("tcp", np.array([HERE, HERE * np.nan])), "tcp: row 1 is not finite"),
    ("infinite step", chunk("tcp_steps", np.full((1, 6), np.inf)), "tcp_steps: row 0 is not finite"),
    ("huge", chunk("tcp_steps", np.full((1, 6), 1e300)), "row 0 has a value beyond 100"),
    ("no rotation", chunk("tcp", np.array([HERE, ROW[0]])), "quaternion of row 1 has length 0, not 1"),
    ("far", chunk("tcp", np.array([HERE, FAR])), "row 1 is not reachable: it is 2"),
    ("jump", chunk("tcp", np.array([HERE, TURNED])), "row 1 is not continuous with the one before it: "
     "panda_joint7 would turn by 1"),
]


@pytest.mark.parametrize("given,text", [row[1:] for row in WRONG], ids=[row[0] for row in WRONG])
def test_what_cannot_be_decoded_is_named(given, text):
    with pytest.raises(PolicyFailed, match=text) as raised:
        decode(given, SEEN, panda())
    assert "\n" not in str(raised.value) and len(str(raised.value)) < 300


def test_integers_and_lists_of_numbers_are_rows():
    decoded, _ = decode(chunk("joint_steps", [[0] * 7]), SEEN, panda())
    np.testing.assert_array_equal(decoded, [READY])


def test_hostile_chunks_raise_nothing_else():
    rng = np.random.default_rng(0)
    specials = np.array([np.nan, np.inf, -np.inf, 1e308, -1e308, 1e-320, 0.0, 2**53, 99.9])
    for _ in range(400):
        kind = rng.choice(["joints", "joint_steps", "tcp", "tcp_steps"])
        shape = (rng.integers(0, 4), {"tcp_steps": 6}.get(kind, 7)) if rng.random() < 0.8 else rng.integers(0, 4, 3)
        values = rng.normal(scale=rng.choice([1e-3, 1.0, 1e3]), size=shape)
        values[rng.random(values.shape) < 0.1] = rng.choice(specials)
        if kind == "tcp" and rng.random() < 0.7 and values.ndim == 2 and len(values):
            with np.errstate(all="ignore"):
                values[:, 3:] /= np.linalg.norm(values[:, 3:], axis=1, keepdims=True)
        with suppress(PolicyFailed):
            rows, _ = decode(chunk(kind, values, np.full(len(values), 0.04)), SEEN, panda())
            assert rows.shape == (len(values), 7)
            assert kind.startswith("joint") or np.isfinite(rows).all()
