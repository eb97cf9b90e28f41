"""`Cell` of the Python client in complete simulated cells on the virtual clock."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Awaitable, Callable
from dataclasses import replace
from functools import partial
from typing import Any

import msgpack
import numpy as np
import pytest

from common import topics
from common.client import operator_motion
from common.client.cell import Cell
from common.client.frames import Frames
from common.client.goals import any_of, pose, region, through
from common.client.operator_motion import JogFailed, MotionFailed
from common.client.subscriptions import NothingReceived
from common.config import load_cell
from common.errors import ConfigError, DecodeError, NoResponder, RemoteError, UnknownName, ZencellError
from common.messages import (
    Header,
    HoldRequest,
    JointGoal,
    Pose,
    StopRequest,
    TFMessage,
    TransformStamped,
    Vector3,
)
from common.transport.bus import Bus
from common.transport.local import LocalNetwork
from lab.simulation import Simulation

pytestmark = pytest.mark.timeout(600)

Program = Callable[[Cell], Awaitable[None]]


class Over(Exception):
    """The program has ended."""


def run(program: Program, cell: str = "panda", *overrides: str, autostart: bool = False) -> None:
    """Run a program in a cell to its end."""
    loaded = load_cell(cell, [f"autostart={str(autostart).lower()}", *overrides])

    raised: list[BaseException] = []

    async def visit(bus: Bus) -> None:
        try:
            async with Cell.on(bus, owner="program") as joined:
                await program(joined)
        except BaseException as error:
            raised.append(error)
        raise Over  # the rest of the run does not matter here

    simulation = Simulation(loaded, 1, visit=visit)
    with pytest.raises(Over):
        simulation.run()
    if raised:
        raise raised[0]
    assert not simulation.outcome.broken and not simulation.outcome.crashes, simulation.outcome


async def until_moving(cell: Cell) -> None:
    async with asyncio.timeout(5.0):
        while np.abs(await cell.arm.velocities()).max() < 0.02:
            pass


def test_arm_is_read_planned_for_and_moved() -> None:
    async def program(cell: Cell) -> None:
        description = await cell.arm.description()
        assert len(description.joints) == 7 and "home" in description.named_poses
        q = await cell.arm.joints()
        assert np.allclose(q, description.named_poses["home"], atol=1e-3)
        T = await cell.arm.pose()
        assert np.allclose(T, await cell.tf("world", "tcp")) and np.allclose(T[2, :3], [0, 0, -1], atol=1e-3)

        plan = await cell.arm.plan(pose(0.45, 0.1, 0.4), speed=0.5)
        assert plan.joints == tuple(description.joints) and np.allclose(plan.positions[0], q, atol=1e-3)
        assert plan.times[0] == 0 and plan.duration > 0.2
        assert np.allclose(await cell.arm.joints(), q, atol=1e-3), "planning moves nothing"
        assert (await cell.arm.execute(plan)).state == "succeeded"
        T = await cell.arm.pose()
        assert np.allclose(T[:3, 3], [0.45, 0.1, 0.4], atol=2e-3)
        assert np.allclose(T[:3, 2], [0, 0, -1], atol=5e-3)

        await cell.arm.move(pose(0.45, -0.1, 0.4), straight=True)
        await cell.arm.move(pose(0.45, 0.1, 0.4), via=(0.5, 0.0, 0.4))
        assert np.allclose((await cell.arm.pose())[:3, 3], [0.45, 0.1, 0.4], atol=2e-3)
        await cell.arm.move(pose(0.45, -0.1, 0.4), around=(0.4, 0.0, 0.4))
        await cell.arm.move(through(pose(0.4, 0.0, 0.4), pose(0.4, 0.1, 0.4), tool_speed=0.1))
        await cell.arm.move(region(pose(0.5, 0.0, 0.4), size=(0.02, 0.02, 0.02), yaw=3.0))
        await cell.arm.move(any_of("home", JointGoal(positions=q.tolist())))
        assert np.allclose(await cell.arm.joints(), q, atol=2e-3)
        assert (await cell.arm.owner_now()).owner in ("", "program")

    run(program)


def test_unreachable_and_invalid_goals_raise_one_line_and_move_nothing() -> None:
    async def program(cell: Cell) -> None:
        before = await cell.arm.joints()
        for to, how, error, words in (
            ("hoem", {}, MotionFailed, "home"),
            (pose(3.0, 0.0, 0.4), {}, MotionFailed, "operator"),
            ([0.1, 0.2], {}, MotionFailed, "operator"),
            ([], {}, ConfigError, "name of a pose"),
            ({"x": 1}, {}, ConfigError, "name of a pose"),
            ([0.0, np.nan], {}, ConfigError, "finite"),
            (2 * np.eye(4), {}, ConfigError, "rotation"),
            ("home", {"speed": 2.0}, ConfigError, "velocity_scaling"),
            ("home", {"speed": 0}, ConfigError, "velocity_scaling"),
            ([1e300] * 7, {}, ConfigError, "positions"),
            (pose(1e30, 0.0, 0.0), {}, ConfigError, "position.x"),
            (pose(0.4, 0.0, 0.4), {"via": (0.4, 0.1, 0.4), "around": (0.4, 0.1, 0.4)}, ConfigError, "via or center"),
            (pose(0.4, 0.0, 0.4), {"via": (0.4, 0.1, 0.4), "straight": True}, ConfigError, "straight"),
            (pose(0.4, 0.0, 0.4), {"goal": 3}, ConfigError, "goal"),
            ("home", {"sped": 2.0}, ConfigError, "choices"),
            ("home", {"via": (1, 2)}, ConfigError, "pose"),
            ("home", {"planner": "unknown"}, (MotionFailed, RemoteError), "unknown"),
        ):
            with pytest.raises(error, match=words) as caught:
                await cell.arm.move(to, **how)  # type: ignore[arg-type]
            assert "\n" not in str(caught.value)
        for request in (cell.arm.execute(None), cell.arm.stop(None), cell.call(None), cell.call("motion/hold", 3),  # type: ignore[arg-type]
                      cell.arm.jog(linear=(1, 0)), anext(cell.listen(None))):  # type: ignore[arg-type]
            with pytest.raises(ConfigError):
                await request
        with pytest.raises(ConfigError, match="rpy"):
            pose(0.4, 0.0, 0.4, rpy=(0.0, 0.0))
        assert np.allclose(await cell.arm.joints(), before, atol=1e-6)

    run(program)


def test_cancelled_motion_stops_and_the_next_one_succeeds() -> None:
    async def program(cell: Cell) -> None:
        moving = asyncio.create_task(cell.arm.move(pose(0.4, 0.4, 0.3), speed=0.1))
        await until_moving(cell)
        moving.cancel()
        with pytest.raises(asyncio.CancelledError):
            await moving
        await asyncio.sleep(1.0)
        assert np.abs(await cell.arm.velocities()).max() < 1e-3 and (await cell.arm.status()).state == "cancelled"
        await cell.arm.move("home")

    run(program)


def test_motion_stops_and_its_task_is_cancelled_when_the_cell_is_left() -> None:
    async def program(cell: Cell) -> None:
        async with Cell.on(cell.bus, owner="program") as inner:
            moving = asyncio.create_task(inner.arm.move(pose(0.4, 0.4, 0.3), speed=0.1))
            await until_moving(cell)
            with pytest.raises(ZencellError, match="joined already"):
                await inner.__aenter__()
        assert moving.cancelled()
        await asyncio.sleep(1.0)
        assert (await cell.arm.status()).state == "cancelled" and np.abs(await cell.arm.velocities()).max() < 1e-3

    run(program)


def test_motion_releases_the_stop_of_its_own_operator_but_not_that_of_another() -> None:
    async def program(cell: Cell) -> None:
        await cell.arm.stop("lunch")
        assert "lunch" in (await cell.arm.status()).stopped
        await cell.arm.move("home")
        assert (await cell.gripper.open()).state == "succeeded"
        other = Cell.on(cell.bus, owner="other")
        for seconds in (0.2, 1.0):
            with pytest.raises(JogFailed, match="lunch"):
                await other.arm.jog(linear=(0.0, 0.0, 0.1), seconds=seconds)
        stop = cell.bus.client(topics.MOTION_STOP)
        await stop.call(StopRequest(owner="another", reason="obstructed"))
        with pytest.raises(MotionFailed, match="another") as refused:
            await cell.arm.move("home")
        assert refused.value.code == "stopped"
        with pytest.raises(MotionFailed, match="another"):
            await cell.gripper.open()

    run(program)


def test_jog_of_a_stalled_program_reports_late_commands(monkeypatch: pytest.MonkeyPatch) -> None:
    async def program(cell: Cell) -> None:
        async def stall() -> None:
            while not (await cell.arm.owner_now()).jogging:  # noqa: ASYNC110 - there is no event for it
                await asyncio.sleep(0.01)
            monkeypatch.setattr(operator_motion, "JOG_PERIOD", 1.0)  # longer than the arm moves without a command

        stalling = asyncio.create_task(stall())
        with pytest.raises(JogFailed, match="; commands of this program arrived too late"):
            await cell.arm.jog(linear=(0.0, 0.0, 0.05), seconds=10.0)
        await stalling
        assert np.abs(await cell.arm.velocities()).max() < 1e-3

    run(program)


def test_own_stop_during_planning_blocks_the_motion() -> None:
    async def program(cell: Cell) -> None:
        before, plan = await cell.arm.joints(), cell.arm._motion.plan

        async def stopped_meanwhile(*goal: Any, **more: Any) -> Any:
            found = await plan(*goal, **more)
            await Cell.on(cell.bus, owner="program").arm.stop("wait")  # the same operator, in another terminal
            return found

        cell.arm._motion.plan = stopped_meanwhile  # type: ignore[method-assign]
        with pytest.raises(MotionFailed, match="wait") as refused:
            await cell.arm.move(pose(0.45, 0.1, 0.4))
        assert refused.value.code == "stopped"
        assert "wait" in (await cell.arm.status()).stopped
        assert np.allclose(await cell.arm.joints(), before, atol=1e-6)

    run(program)


def test_held_motion_continues_after_its_release() -> None:
    async def program(cell: Cell) -> None:
        moving = asyncio.create_task(cell.arm.move(pose(0.4, 0.4, 0.3), speed=0.2))
        await until_moving(cell)
        await cell.arm.hold("a visitor comes")
        await asyncio.sleep(1.0)
        where = await cell.arm.joints()
        await asyncio.sleep(0.5)
        assert np.allclose(await cell.arm.joints(), where, atol=1e-6) and not moving.done()
        await cell.arm.release()
        assert (await moving).state == "succeeded"

    run(program)


def test_owned_block_keeps_other_clients_from_moving() -> None:
    async def program(cell: Cell) -> None:
        other = Cell.on(cell.bus, owner="other")
        async with cell.arm.owned() as owner:
            assert (owner.owner, owner.kind) == ("program", "script")
            with pytest.raises(MotionFailed) as refused:
                await other.arm.move(pose(0.4, 0.1, 0.4))
            assert refused.value.code == "not_owner"
            with pytest.raises(RemoteError):
                await other.arm.own("take")
            await cell.arm.move("home")
        async for owner in cell.listen("motion/owner"):
            if owner.kind == "none":
                break
        await other.arm.move("home")

    run(program)


def test_nested_owned_block_does_not_give_authority_back() -> None:
    async def program(cell: Cell) -> None:
        async with cell.arm.owned():
            async with cell.arm.owned():
                await cell.arm.move("home")
            with pytest.raises(RemoteError):
                await Cell.on(cell.bus, owner="other").arm.own("take")
            assert (await cell.arm.owner_now()).owner == "program"
        other = Cell.on(cell.bus, owner="other")
        await other.arm.own("take")
        await other.arm.own("give")
        async with cell.arm.owned(lease=1.0):
            async with cell.arm.owned():
                pass
            await asyncio.sleep(2.0)  # like a program that hangs
            assert (await cell.arm.owner_now()).kind == "none"

    run(program)


@pytest.mark.parametrize("after", [0.0, 0.001, 0.002, 0.01])
def test_cancelled_take_leaves_no_motion_authority(after: float) -> None:
    async def program(cell: Cell) -> None:
        async def own() -> None:
            async with cell.arm.owned():
                await asyncio.sleep(5.0)

        owning = asyncio.create_task(own())
        await asyncio.sleep(after)
        owning.cancel()
        with pytest.raises(asyncio.CancelledError):
            await owning
        await asyncio.sleep(0.05)  # until the executor publishes the owner
        assert (await cell.arm.owner_now()).kind == "none"

    run(program)


def test_jogging_moves_for_the_requested_time() -> None:
    async def program(cell: Cell) -> None:
        before = await cell.arm.pose()
        await cell.arm.jog(linear=(0.0, 0.1, 0.0), seconds=1.0)
        await asyncio.sleep(0.5)
        after = await cell.arm.pose()
        moved = after[:3, 3] - before[:3, 3]
        for seconds in (0.01, 0.1, 0.2):
            await cell.arm.jog(linear=(0.0, -0.1, 0.0), seconds=seconds)
            assert not (await cell.arm.owner_now()).jogging
        await cell.arm.move("home")  # the arm is at rest when jogging returns
        assert 0.03 < moved[1] < 0.11 and abs(moved[0]) < 5e-3 and abs(moved[2]) < 5e-3
        assert np.abs(await cell.arm.velocities()).max() < 1e-3
        with pytest.raises(UnknownName, match="elbow"):
            await cell.arm.jog(joints={"elbow": 0.1})
        with pytest.raises(ConfigError, match="60 s"):
            await cell.arm.jog(linear=(0.1, 0, 0), seconds=1e9)

    run(program)


def test_gripper_opens_closes_and_reports_whether_it_holds() -> None:
    async def program(cell: Cell) -> None:
        opened = await cell.gripper.open()
        assert opened.state == "succeeded" and opened.width == pytest.approx(0.08, abs=2e-3)
        closed = await cell.gripper.move(0.02, 20.0)
        assert closed.width == pytest.approx(0.02, abs=2e-3) and not closed.holding
        empty = await cell.gripper.close(expected=0.04)
        assert (empty.state, empty.outcome) == ("aborted", "empty")
        assert (await cell.gripper.state()).width < 2e-3
        with pytest.raises(ConfigError, match="width"):
            await cell.gripper.move(5.0)

    run(program)


def test_a_pick_takes_ten_lines() -> None:
    async def program(cell: Cell) -> None:
        await cell.gripper.open()
        ball, *_ = await cell.objects(least=1)
        x, y, z = ball.pose.position.x, ball.pose.position.y, ball.pose.position.z
        await cell.arm.move(pose(x, y, z + 0.15))
        await cell.arm.move(pose(x, y, z), straight=True, touch=ball.id)
        assert (await cell.gripper.close()).holding
        await cell.arm.move(pose(x, y, z + 0.15), straight=True)
        (held,) = [each.id for each in await cell.world.objects() if each.state == "held"]
        assert (await cell.gripper.state()).holding and held

    run(program, "panda", "world.count=1")


def test_images_are_arrays_with_their_camera() -> None:
    async def program(cell: Cell) -> None:
        (name,) = await cell.cameras()
        camera = await cell.camera()
        assert camera.name == name
        info, image = await camera.info(), await camera.image()
        assert image.shape == (info.height, info.width, 3) and image.dtype == np.uint8 and image.std() > 1
        assert (await camera.intrinsics())[0, 0] == info.k[0]
        T = await camera.pose()
        assert T.shape == (4, 4) and T[2, 3] > 0.2, "above the table"
        first, second = await camera.message(), await camera.message()
        assert second.header.stamp > first.header.stamp
        with pytest.raises(UnknownName, match=name):
            await cell.camera("left")

    run(program)


def test_camera_is_looked_up_at_first_use() -> None:
    async def program(cell: Cell) -> None:
        (name,) = await cell.cameras()
        assert (await cell.camera().image()).shape == (await cell.camera(name).image()).shape
        camera = cell.camera()
        assert (await camera.intrinsics()).shape == (3, 3) and camera.name == name
        with pytest.raises(UnknownName, match=name):
            await cell.camera("left").pose()

    run(program)


def test_depth_is_in_metres() -> None:
    async def program(cell: Cell) -> None:
        depth = await (await cell.camera()).depth()
        assert depth.dtype == np.float32 and 0.2 < np.nanmedian(depth) < 3.0

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
        before = {each.id for each in truth}
        ids = await cell.world.add(0.45, -0.1)
        (new,) = set(ids) - before
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
        for value in (np.int64(7), np.float32(8), np.array(9)):  # numpy values, as computed from images
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
        states = []
        async for status in cell.task:
            states.append(status.state)
            with pytest.raises(MotionFailed, match="task"):
                await cell.arm.move("home")
            if status.done:
                break
        assert len(set(states)) > 2
        await cell.task.pause()
        await cell.task.resume()
        assert not (await cell.task.stop()).started
        await cell.arm.move("home")
        await cell.task.start()
        assert (await cell.task.ended()).state == "DONE"

    run(program, "panda", "world.count=2")


def test_any_key_can_be_called_or_listened_to() -> None:
    async def program(cell: Cell) -> None:
        async for state in cell.listen("joint_states"):
            assert len(state.position) >= 7
            break
        answer = await cell.call("motion/hold", hold=True, owner="program")
        again = await cell.call(topics.MOTION_HOLD, HoldRequest(hold=True, owner="program"))
        assert answer.held and again.held and [each.by for each in again.interlocks] == ["program"]
        await cell.arm.release()
        for request, error, words in (
            (cell.call("motion/hodl"), UnknownName, "motion/hold"),
            (cell.call("motion/hold", hodl=True), ConfigError, "hold"),
            (cell.call("motion/hold", hold=True, timeout=-1), ConfigError, "timeout"),
            (anext(cell.listen("motion/hold")), ConfigError, "is a request"),
            (anext(cell.listen("joint_state")), UnknownName, "did you mean 'joint_states'"),
            (anext(cell.listen("/joint_states", plain=True)), UnknownName, "did you mean 'joint_states'"),
        ):
            with pytest.raises(error, match=words):
                await request
        with pytest.raises(NothingReceived, match="scene_object_updates"):
            async for _ in cell.listen("scene_object_updates", timeout=0.5):
                pass
        async for packed in cell.listen("joint_states", plain=True):
            assert len(packed["position"]) >= 7
            break
        for payload, expected in ((msgpack.packb({1: 2}), {1: 2}), (b"hello", DecodeError), (b"", DecodeError)):
            coming = asyncio.create_task(anext(cell.listen("others", plain=True)))
            await asyncio.sleep(0.1)  # virtual time, until the subscription exists
            cell.bus.raw_writer(f"{cell.name}/others", "", "event").put(payload)
            if expected is DecodeError:
                with pytest.raises(DecodeError, match=r"panda/others: .* are not msgpack"):
                    await coming
            else:
                assert await coming == expected
        assert any(service.name == "motion_planner" for service in (await cell.services()).services)

    run(program)


def test_unanswered_requests_raise_the_matching_exception() -> None:
    async def program(cell: Cell) -> None:
        with pytest.raises(NoResponder, match="param/missing"):
            await cell.call("param/missing")
        with pytest.raises(NothingReceived, match="missing/camera_info"):
            await cell._subscriptions.latest(replace(topics.CAMERA_INFO, key="missing/camera_info"))
        with pytest.raises(RemoteError, match="controller"):
            await cell.arm.order("enable")

    run(program, "ur5")


async def test_outdated_transform_is_not_the_current_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.client.frames.TIMEOUT", 0.2)
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
    for _ in range(2):  # also while the other one moves
        where = asyncio.create_task(cell.tf("world", "link"))
        await publish(3, "other")
        with pytest.raises(NothingReceived, match="tf of link within"):
            await where
    async with Frames(cell.bus) as frames:
        known = asyncio.create_task(frames.until_known("world", "link"))
        await publish(4, "link", "other")
        await known
        with pytest.raises(NothingReceived, match="tf of link within"):
            while True:
                await publish(5, "other")
                frames.require_recent("world", "link")
                assert frames.tree.pose("world", "link")[0, 3] == 4
                await asyncio.sleep(0.01)


@pytest.mark.parametrize("owner", ["x" * 121, "two\nlines", 5])
def test_invalid_owner_is_refused_before_any_request(owner: Any) -> None:
    for made in (Cell, partial(Cell.start, "panda")):
        with pytest.raises(ConfigError, match="owner"):
            made(owner=owner)


async def test_cell_that_is_not_joined_explains_how_to_join_it() -> None:
    cell = Cell("panda")
    for name in ("arm", "gripper", "task", "param", "world", "bus"):
        with pytest.raises(ZencellError, match="async with"):
            getattr(cell, name)
    with pytest.raises(ZencellError, match="async with"):
        cell.camera()
    with pytest.raises(AttributeError, match="amr"):
        _: Any = cell.amr


def test_assignment_to_an_attribute_is_refused_with_a_suggestion() -> None:
    async def program(cell: Cell) -> None:
        for part, name, words in (
            (cell, "parm", "Cell.parm does not exist: did you mean 'param'?"),
            (cell, "param", "Cell.param cannot be set"),
            (cell.arm, "speeed", "Arm.speeed does not exist"), (cell.arm, "owner", "Arm.owner cannot be set"),
            (cell.gripper, "wdith", "Gripper.wdith"), (cell.task, "pausse", "did you mean 'pause'"),
            (cell.world, "ad", "'add'"), (cell.scene, "ad", "'add'"), (cell.param, "sett", "'set'"),
            (await cell.camera(), "imgae", "'image'"),
        ):
            with pytest.raises(ZencellError, match=re.escape(words)) as caught:
                setattr(part, name, 3)
            assert "\n" not in str(caught.value) and isinstance(caught.value, AttributeError)
        assert cell.owner == cell.arm.owner == "program"
        await cell.objects(least=1)
        with pytest.raises(UnknownName, match=r"unknown object to touch 'track_l' \(did you mean 'track_\d'\?\)"):
            await cell.arm.plan("home", touch=["track_l"])
        await cell.arm.plan("home", touch="track_1")

    run(program)
