"""Cameras, objects, parameters, task and keys of the Python client in complete simulated cells."""

from __future__ import annotations

import asyncio
import re
from dataclasses import replace
from functools import partial
from typing import Any

import msgpack
import numpy as np
import pytest

from common import topics
from common.client.cell import Cell
from common.client.frames import Frames
from common.client.operator_motion import MotionFailed
from common.client.subscriptions import NothingReceived
from common.errors import ConfigError, DecodeError, NoResponder, RemoteError, UnknownName, ZencellError
from common.messages import Header, HoldRequest, Pose, TFMessage, TransformStamped, Vector3
from common.transport.local import LocalNetwork
from tests.client.simulated_cell import run

pytestmark = pytest.mark.timeout(600)


def test_images_are_arrays_of_a_camera_that_is_looked_up_at_first_use() -> None:
    async def program(cell: Cell) -> None:
        (name,) = await cell.cameras()
        camera = await cell.camera()
        info, image = await camera.info(), await camera.image()
        assert camera.name == name and image.dtype == np.uint8 and image.std() > 1
        assert image.shape == (info.height, info.width, 3) == (await cell.camera(name).image()).shape
        T = await camera.pose()
        assert T.shape == (4, 4) and T[2, 3] > 0.2, "above the table"
        first, second = await camera.message(), await camera.message()
        assert second.header.stamp > first.header.stamp
        lazy = cell.camera()
        assert (await lazy.intrinsics())[0, 0] == info.k[0] and lazy.name == name
        for request in (cell.camera("left"), cell.camera("left").pose()):
            with pytest.raises(UnknownName, match=name):
                await request

    run(program)


def test_depth_is_in_meters_and_unanswered_requests_raise_the_matching_exception() -> None:
    async def program(cell: Cell) -> None:
        depth = await (await cell.camera()).depth()
        assert depth.dtype == np.float32 and 0.2 < np.nanmedian(depth) < 3.0
        missing = replace(topics.CAMERA_INFO, key="missing/camera_info")
        for request, error, words in (
            (cell.call("param/missing"), NoResponder, "param/missing"),
            (cell._subscriptions.latest(missing), NothingReceived, "missing/camera_info"),
            (cell.arm.order("enable"), RemoteError, "controller"),
        ):
            with pytest.raises(error, match=words):
                await request

    run(program, "ur5")


def test_objects_are_perceived_and_the_world_is_edited_by_name() -> None:
    async def program(cell: Cell) -> None:
        seen, truth = await cell.objects(least=2), await cell.world.objects()
        assert len(seen) == len(truth) == 2 and all(each.role == "target" for each in seen)
        for each in truth:
            nearest = min(seen, key=lambda found: np.hypot(
                found.pose.position.x - each.pose.position.x, found.pose.position.y - each.pose.position.y))
            assert nearest.pose.position.x == pytest.approx(each.pose.position.x, abs=0.01)
        with pytest.raises(NothingReceived, match="with 3 objects, only with 2"):
            await cell.objects(least=3, timeout=1.0)
        (new,) = set(await cell.world.add(0.45, -0.1)) - {each.id for each in truth}
        assert len(await cell.objects(least=3)) == 3
        assert new not in await cell.world.remove(new)
        with pytest.raises(RemoteError, match="nothing"):
            await cell.world.remove("nothing")
        await cell.world.reset()

    run(program, "panda", "world.count=2")


def test_parameters_are_read_and_changed_by_path() -> None:
    async def program(cell: Cell) -> None:
        path = "vision_detector.min_contour_area_px"
        before = await cell.param[path]
        await cell.param.set(path, before + 5)
        assert await cell.param[path] == before + 5 == (await cell.param.all())[f"services.{path}"]
        for value in (np.int64(7), np.float32(8), np.array(9)):  # as computed from images
            await cell.param.set(path, value)
            assert await cell.param[path] == value
        for value in (object(), np.array([1, 2])):
            with pytest.raises(ZencellError, match="min_contour_area_px"):
                await cell.param.set(path, value)
        with pytest.raises(UnknownName, match="did you mean"):
            await cell.param["vision_detector.min_contour_area"]
        with pytest.raises(ZencellError, match="min_contour_area_px"):
            await cell.param.update({path: "large", "trajectory_executor.speed_scaling": 0.5})
        assert await cell.param["trajectory_executor.speed_scaling"] == 1.0, "all of them or none"

    run(program)


def test_task_is_started_observed_and_stopped() -> None:
    async def program(cell: Cell) -> None:
        assert not (await cell.task.status()).started
        await cell.task.start()
        states = set()
        async for status in cell.task:
            states.add(status.state)
            with pytest.raises(MotionFailed, match="task"):
                await cell.arm.move("home")
            if status.done:
                break
        assert len(states) > 2
        await cell.task.pause()
        await cell.task.resume()
        assert not (await cell.task.stop()).started
        await cell.arm.move("home")
        await cell.task.start()
        assert (await cell.task.ended()).state == "DONE"

    run(program, "panda", "world.count=1")


def test_any_key_can_be_called_or_listened_to() -> None:
    async def program(cell: Cell) -> None:
        assert len((await anext(cell.listen("joint_states"))).position) >= 7
        assert len((await anext(cell.listen("joint_states", plain=True)))["position"]) >= 7
        answer = await cell.call("motion/hold", hold=True, owner="program")
        again = await cell.call(topics.MOTION_HOLD, HoldRequest(hold=True, owner="program"))
        assert answer.held and again.held and [each.by for each in again.interlocks] == ["program"]
        await cell.arm.release()
        for request, error, words in (
            (cell.call(None), ConfigError, "."), (cell.call("motion/hold", 3), ConfigError, "."),  # type: ignore[arg-type]
            (anext(cell.listen(None)), ConfigError, "."),  # type: ignore[arg-type]
            (cell.call("motion/hodl"), UnknownName, "motion/hold"),
            (cell.call("motion/hold", hodl=True), ConfigError, "hold"),
            (cell.call("motion/hold", hold=True, timeout=-1), ConfigError, "timeout"),
            (anext(cell.listen("motion/hold")), ConfigError, "is a request"),
            (anext(cell.listen("joint_state")), UnknownName, "did you mean 'joint_states'"),
            (anext(cell.listen("/joint_states", plain=True)), UnknownName, "did you mean 'joint_states'"),
            (anext(cell.listen("scene_object_updates", timeout=0.5)), NothingReceived, "scene_object_updates"),
        ):
            with pytest.raises(error, match=words):
                await request
        writer = cell.bus.raw_writer(f"{cell.name}/others", "", "event")
        for payload, expected in ((msgpack.packb({1: 2}), {1: 2}), (b"hello", DecodeError), (b"", DecodeError)):
            coming = asyncio.create_task(anext(cell.listen("others", plain=True)))
            async with asyncio.timeout(5.0):
                while not coming.done():  # noqa: ASYNC110 - the first may precede the subscription
                    writer.put(payload)
                    await asyncio.sleep(0.01)
            if expected is DecodeError:
                with pytest.raises(DecodeError, match=r"panda/others: .* are not msgpack"):
                    await coming
            else:
                assert await coming == expected
        assert any(service.name == "motion_planner" for service in (await cell.services()).services)

    run(program)


async def test_outdated_transform_is_not_the_current_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    net = LocalNetwork()
    writer, cell = net.bus("robot_state_publisher").writer(topics.TF), Cell.on(net.bus("program"))

    async def publish(stamp: int, *names: str) -> None:
        for _ in range(50):
            await asyncio.sleep(0)
        writer.put(TFMessage(transforms=[
            TransformStamped(header=Header(stamp=stamp, frame_id="world"), child_frame_id=name, transform=Pose(
                position=Vector3(x=float(stamp)))) for name in names]))

    for stamp in (1, 2):
        where = asyncio.create_task(cell.tf("world", "link"))
        await publish(stamp, "link", "other")
        assert (await where)[0, 3] == stamp
    with monkeypatch.context() as hurried:
        hurried.setattr("common.client.frames.TIMEOUT", 0.05)
        for _ in range(2):  # also while the other one moves
            where = asyncio.create_task(cell.tf("world", "link"))
            await publish(3, "other")
            with pytest.raises(NothingReceived, match="tf of link within"):
                await where
    async with Frames(cell.bus) as frames:
        known = asyncio.create_task(frames.until_known("world", "link"))
        await publish(4, "link", "other")
        await known
        monkeypatch.setattr("common.client.frames.TIMEOUT", 0.05)
        with pytest.raises(NothingReceived, match="tf of link within"):
            while True:
                await publish(5, "other")
                frames.require_recent("world", "link")
                assert frames.tree.pose("world", "link")[0, 3] == 4


@pytest.mark.parametrize("owner", ["x" * 121, "two\nlines", 5])
def test_invalid_owner_is_refused_before_any_request(owner: Any) -> None:
    for make in (Cell, partial(Cell.start, "panda")):
        with pytest.raises(ConfigError, match="owner"):
            make(owner=owner)


async def test_cell_that_is_not_joined_explains_how_to_join_it() -> None:
    cell = Cell("panda")
    for name in ("arm", "gripper", "task", "param", "world", "bus"):
        with pytest.raises(ZencellError, match="async with"):
            getattr(cell, name)
    with pytest.raises(ZencellError, match="async with"):
        cell.camera()
    with pytest.raises(AttributeError, match="amr"):
        _: Any = cell.amr


async def test_assignment_to_an_attribute_is_refused_with_a_suggestion() -> None:
    cell = Cell.on(LocalNetwork().bus("program"), owner="program")
    for part, name, words in (
        (cell, "parm", "Cell.parm does not exist: did you mean 'param'?"), (cell, "param", "Cell.param cannot be set"),
        (cell.arm, "speeed", "Arm.speeed does not exist"), (cell.arm, "owner", "Arm.owner cannot be set"),
        (cell.gripper, "wdith", "Gripper.wdith"), (cell.task, "pausse", "did you mean 'pause'"),
        (cell.world, "ad", "'add'"), (cell.scene, "ad", "'add'"), (cell.param, "sett", "'set'"),
        (cell.camera(), "imgae", "'image'"),
    ):
        with pytest.raises(ZencellError, match=re.escape(words)) as caught:
            setattr(part, name, 3)
        assert "\n" not in str(caught.value) and isinstance(caught.value, AttributeError)
    assert cell.owner == cell.arm.owner == "program"
