"""A function of the user's is a policy; what it does wrong is one line and never blocks."""

import asyncio
import subprocess
import sys
import threading
from contextlib import suppress

import numpy as np
import pytest
from pinocchio import exp3

from applications.policy.decoding import decode
from applications.policy.interface import Chunk, PolicyFailed
from applications.policy.sources import source
from applications.policy.sources.settings import SourceConfig
from common.config.basics import check
from common.errors import ConfigError
from tests.applications.policy.panda import READY, STAMP, observation, panda, panda_cell

SEEN = observation("top")
HERE = "tests.applications.policy.test_function_source"
release = threading.Event()


def rows(seen):
    assert seen.instruction == "pick the ball"
    return np.tile(seen.positions, (4, 1))


async def rows_async(seen):
    await asyncio.sleep(0)
    return np.tile(seen.positions, (4, 1))


def with_gripper(seen):
    return np.tile([*seen.positions, 1.0], (4, 1))


def with_widths(seen):
    return np.tile(seen.positions, (4, 1)), np.full(4, 0.02)


def chunk(seen):
    return Chunk(seen.stamp, 10.0, "joint_steps", np.zeros((4, 7)), np.full(4, 0.08))


def changes_its_observation(seen):
    seen.positions[:] = 99
    seen.images["top"][:] = 0
    return np.zeros((1, 7))


def waits(seen):
    release.wait(20)
    return rows(seen)


async def waits_async(seen):
    await asyncio.sleep(1000)


async def does_not_end(seen):
    while not release.is_set():
        with suppress(asyncio.CancelledError):
            await asyncio.sleep(0.05)


def crashes(seen):
    raise ValueError("two\nlines")


async def crashes_async(seen):
    raise KeyError("x")


def exits(seen):
    raise SystemExit(3)


async def exits_async(seen):
    raise SystemExit(3)


async def cancels_itself(seen):
    raise asyncio.CancelledError


def ends_an_iterator(seen):
    return next(iter(()))


def returns_none(seen):
    return None


def returns_wrong_shape(seen):
    return np.zeros((3, 5))


def returns_objects(seen):
    return np.array([[object()] * 7])


def returns_ragged(seen):
    return [[1, 2], [3]]


class Lies:
    def __array__(self, dtype=None, copy=None):
        raise RuntimeError("no array")


def lies(seen):
    return Lies()


class Unprintable(Exception):
    def __str__(self):
        raise ValueError("no text")


def fails_without_text(seen):
    raise Unprintable


class Policy:
    async def __call__(self, seen):
        return np.tile(seen.positions, (4, 1))


an_object = Policy()


def made(name, timeout=30.0, **actions):
    return source(SourceConfig(callable=f"{HERE}:{name}", timeout=timeout, actions=actions), panda_cell("top"))


@pytest.mark.parametrize("name,actions,widths", [
    ("rows", {}, None), ("rows_async", {}, None), ("an_object", {}, None), ("chunk", {}, 0.08),
    ("with_widths", {}, 0.02), ("with_gripper", {}, 1.0),
    ("with_gripper", {"gripper_open": -1.0, "gripper_closed": 1.0}, 0.0),
    ("with_gripper", {"gripper_open": 1.0, "gripper_closed": -1.0}, 0.08)])
async def test_function_returns_actions(name, actions, widths):
    decoded, found = decode(await made(name, **actions).infer(SEEN), SEEN, panda())
    np.testing.assert_allclose(decoded, np.tile(READY, (4, 1)))
    assert found is None if widths is None else (found == pytest.approx(np.full(4, widths)))


async def test_function_gets_a_copy():
    await made("changes_its_observation").infer(SEEN)
    np.testing.assert_array_equal(SEEN.positions, READY)
    assert SEEN.images["top"].all()


@pytest.mark.parametrize("name,text", [
    ("crashes", r"failed at test_function_source.py:\d+: ValueError: two lines"), ("crashes_async", "KeyError: 'x'"),
    ("exits", r"test_function_source.py:\d+: RuntimeError: SystemExit: 3"), ("returns_none", "not NoneType"),
    ("returns_wrong_shape", r"shape \(n, 7\) or, with the gripper, \(n, 8\), n at most 1000; they are 3x5"),
    ("exits_async", "RuntimeError: SystemExit: 3"), ("cancels_itself", "RuntimeError: CancelledError$"),
    ("ends_an_iterator", r"test_function_source.py:\d+: RuntimeError: StopIteration$"),
    ("returns_objects", "of numbers, not ndarray"), ("returns_ragged", "actions must be an array"),
    ("lies", "RuntimeError: no array"), ("fails_without_text", ": Unprintable$")])
async def test_wrong_result_is_one_line(name, text):
    with pytest.raises(PolicyFailed, match=text) as raised:
        await made(name).infer(SEEN)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("name", ["waits", "waits_async", "does_not_end"])
async def test_function_that_does_not_return_fails_in_time_and_is_not_called_twice(name):
    release.clear()
    policy = made(name, timeout=0.05)
    with pytest.raises(PolicyFailed, match=r"returned nothing within 0\.05 s"):
        await policy.infer(SEEN)
    if name != "waits_async":
        with pytest.raises(PolicyFailed, match="still computes since"):
            await policy.infer(SEEN)
    release.set()
    await policy.close()


def test_process_ends_although_a_function_does_not():
    code = ("import asyncio, time\n"
            "from applications.policy.sources.computing import Computation\n"
            "try:\n    asyncio.run(Computation('it', 0.05).call(time.sleep, 1000))\n"
            "except Exception as error:\n    print(error)\n")
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=30, check=True)
    assert ended.stdout == "it returned nothing within 0.05 s\n"


@pytest.mark.parametrize("name,text", [
    ("rows", "must be dotted.module:name"), (f"{HERE}:none", "has no function none; choices: .*rows_async"),
    ("no.such.module:policy", "is not a module"), (f"{HERE}:READY", "has no function READY")])
def test_unknown_function_is_named(name, text):
    with pytest.raises(ConfigError, match=rf"source\.callable: .*{text}"):
        source(SourceConfig(callable=name), panda_cell())


@pytest.mark.parametrize("values,text", [
    ({}, "exactly one of callable, onnx, openpi is required, not none"),
    ({"onnx": "a", "openpi": "b"}, "not onnx and openpi"),
    ({"callable": "a.b:c", "actions": {"kind": "tcp", "cumulative": True}}, "cumulative has no meaning for kind tcp"),
    ({"callable": "a.b:c", "actions": {"gripper_open": 0.0}}, "must differ"),
    ({"callable": "a.b:c", "actions": {"rate": 0}}, "actions.rate: 0 must be greater than 0"),
    ({"callable": "a.b:c", "actions": {"kind": "speeds"}}, "actions.kind: 'speeds' must be 'joints'")])
def test_wrong_settings_are_named(values, text):
    with pytest.raises(ConfigError, match=text):
        check(SourceConfig, values, "source")


async def test_steps_from_row_to_row_are_summed_and_scaled():
    velocities = np.tile(np.arange(7.0), (3, 1))
    policy = made("rows", kind="joint_steps", cumulative=True, scale=[0.1])
    policy._computation.call = lambda *_: asyncio.sleep(0, velocities)
    decoded, _ = decode(await policy.infer(SEEN), SEEN, panda())
    np.testing.assert_allclose(decoded, READY + 0.1 * np.outer([1, 2, 3], np.arange(7.0)))


async def test_rotation_steps_from_row_to_row_are_composed():
    policy = made("rows", kind="tcp_steps", cumulative=True, scale=[1, 1, 1, 0.5, 0.5, 0.5])
    steps = np.array([[0.01, 0, 0, 0.2, 0, 0], [0, 0.01, 0, 0, 0.2, 0]])
    policy._computation.call = lambda *_: asyncio.sleep(0, steps)
    values = (await policy.infer(SEEN)).values
    np.testing.assert_allclose(values[1, :3], [0.01, 0.01, 0])
    turned = exp3(np.array([0, 0.1, 0])) @ exp3(np.array([0.1, 0, 0]))
    np.testing.assert_allclose(exp3(values[1, 3:]), turned, atol=1e-9)
    assert (await policy.infer(SEEN)).stamp == STAMP
