"""Large requests are decoded outside the loop, in pieces and in order; costly payloads are refused early."""

import asyncio
import gc
import threading
from time import process_time
from typing import Any

import msgpack
import pytest

from common import messages as m
from common.errors import DecodeError
from common.messages.basics import SMALL_BYTES, Message
from common.messages.robot import MAX_POINTS
from common.topics import MOTION_EXECUTE
from common.transport.codec import decode, encode
from common.transport.local import LocalNetwork

JOINTS = [f"panda_joint{i}" for i in range(1, 8)]


def execute(points: int, name: str = "a") -> m.ExecuteRequest:
    row = [0.125] * 7
    made = [m.JointTrajectoryPoint.model_construct(
        time_from_start=0.01 * i, positions=row, velocities=row, accelerations=row) for i in range(points)]
    return m.ExecuteRequest(
        id=name, trajectory=m.JointTrajectory.model_construct(header=m.Header(), joint_names=JOINTS, points=made))


@pytest.mark.parametrize(("model", "payload"), [
    (m.PoseArray, msgpack.packb({"poses": [{}] * 30_000})),
    (m.Image, msgpack.packb({"data": [[]] * 1_000_000})),
    (m.PlanningScene, msgpack.packb({"objects": [{}] * 200_000})),
    (m.PlanRequest, msgpack.packb({"goal": [[0]] * 1_000_000})),
    (m.ServiceCounters, msgpack.packb({"service": "a", "received": {f"{i:x}": "" for i in range(2000)}})),
], ids=lambda value: getattr(value, "__name__", ""))
def test_costly_payloads_are_refused_within_milliseconds(model: type[Message], payload: bytes) -> None:
    times = []
    for _ in range(3):
        began = process_time()
        with pytest.raises(DecodeError):
            decode(model, payload)
        times.append(process_time() - began)
    assert min(times) < 0.15


def test_longest_trajectory_fits_and_decodes_the_same_in_pieces() -> None:
    payload = encode(execute(MAX_POINTS))
    assert len(payload) <= m.ExecuteRequest.max_bytes
    assert decode(m.ExecuteRequest, payload, in_pieces=True) == decode(m.ExecuteRequest, payload)


@pytest.mark.parametrize(("payload", "reason"), [
    (encode(execute(200)) + b"\x00", "1 bytes after the end"),
    (encode(execute(200))[:-1], "not msgpack"),
    (msgpack.packb({1: 1, "id": "a" * SMALL_BYTES}), "not allowed for map key"),
    (msgpack.packb({"id": [[]] * 400_000}), "more than 131072 lists and maps"),
    (msgpack.packb({"id": [0] * 600_000}), "exceeds max_array_len|more than 131072 lists"),
    (msgpack.packb({"id": msgpack.ExtType(5, b"0" * SMALL_BYTES)}), "exceeds max_ext_len"),
    (msgpack.packb({"id": b"a" * SMALL_BYTES})[:-9] + b"\xc1" * 9, r"id: must be a valid string"),
], ids=["more", "less", "key", "lists", "list", "extension", "bytes"])
def test_large_invalid_payloads_are_refused_the_same_in_pieces(payload: bytes, reason: str) -> None:
    for in_pieces in (False, True):
        with pytest.raises(DecodeError, match=reason):
            decode(m.ExecuteRequest, payload, in_pieces=in_pieces)


async def test_large_requests_are_decoded_outside_the_loop_and_in_order(monkeypatch: pytest.MonkeyPatch) -> None:
    in_thread: list[bool] = []
    received: list[str] = []

    def recording_decode(model: Any, payload: bytes, *rest: Any, **more: Any) -> Message:
        if model is m.ExecuteRequest:
            in_thread.append(threading.current_thread() is not threading.main_thread())
        return decode(model, payload, *rest, **more)

    async def handle(request: m.ExecuteRequest) -> m.MotionStatus:
        received.append(request.id)
        return m.MotionStatus(id=request.id)

    monkeypatch.setattr("common.transport.codec.decode", recording_decode)
    network = LocalNetwork()
    server, client = network.bus("server"), network.bus("client")
    server.serve(MOTION_EXECUTE, handle)
    await server.ready()
    calls = client.client(MOTION_EXECUTE)
    sizes = {"large": 4000, "small": 2, "middle": 200, "last": 1}
    answers = await asyncio.gather(*(calls.call(execute(points, name), timeout=30) for name, points in sizes.items()))
    assert in_thread == [True, False, True, False]
    assert received == [answer.id for answer in answers] == list(sizes)
    await client.close()
    await server.close()


def test_garbage_collector_does_not_scan_a_large_message() -> None:
    payload = encode(execute(10_000))
    scanned: list[int] = []

    def note(phase: str, _: dict[str, int]) -> None:
        if phase == "start":
            scanned.append(len(gc.get_objects(0)))

    gc.callbacks.append(note)
    try:
        request = decode(m.ExecuteRequest, payload)
        new_objects = [[] for _ in range(2000)]  # trigger a collection
    finally:
        gc.callbacks.remove(note)
        gc.unfreeze()
    assert len(request.trajectory.points) == 10_000 and new_objects
    assert scanned and max(scanned) < 20_000, "the lists of the points are excluded"
