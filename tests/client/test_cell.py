"""What a program does in a whole cell, on the virtual clock: `Cell` on the bus of a visitor."""

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
from common.client import arm
from common.client.arm import JogFailed
from common.client.cell import Cell
from common.client.frames import poses
from common.client.goals import any_of, pose, region, through
from common.client.operator_motion import MotionFailed
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
    """The program has come to its end."""


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
        raise Over  # the rest of the run is nobody's business here

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


def test_arm_is_read_planned_for_and_moved_in_numbers() -> None:
    async def program(cell: Cell) -> None:
        told = await cell.arm.description()
        assert len(told.joints) == 7 and "home" in told.named_poses
        q = await cell.arm.joints()
        assert np.allclose(q, told.named_poses["home"], atol=1e-3)
        T = await cell.arm.pose()
        assert np.allclose(T, await cell.tf("world", "tcp")) and np.allclose(T[2, :3], [0, 0, -1], atol=1e-3)

        plan = await cell.arm.plan(pose(0.45, 0.1, 0.4), speed=0.5)
        assert plan.joints == tuple(told.joints) and np.allclose(plan.positions[0], q, atol=1e-3)
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


def test_what_cannot_be_reached_or_asked_for_is_said_in_one_line_and_moves_nothing() -> None:
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
            ("home", {"planner": "nobody"}, (MotionFailed, RemoteError), "nobody"),
        ):
            with pytest.raises(error, match=words) as told:
                await cell.arm.move(to, **how)  # type: ignore[arg-type]
            assert "\n" not in str(told.value)
        for asked in (cell.arm.execute(None), cell.arm.stop(None), cell.call(None), cell.call("motion/hold", 3),  # type: ignore[arg-type]
                      cell.arm.jog(linear=(1, 0)), anext(cell.listen(None))):  # type: ignore[arg-type]
            with pytest.raises(ConfigError):
                await asked
        with pytest.raises(ConfigError, match="rpy"):
            pose(0.4, 0.0, 0.4, rpy=(0.0, 0.0))
        assert np.allclose(await cell.arm.joints(), before, atol=1e-6)

    run(program)


def test_a_motion_that_is_cancelled_comes_to_rest_and_the_next_one_goes() -> None:
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


def test_a_motion_stops_when_its_cell_is_left_and_whoever_waits_is_told() -> None:
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


def test_stop_of_ones_own_is_ended_by_the_next_motion_and_that_of_others_is_not() -> None:
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
        await stop.call(StopRequest(owner="another", reason="in the way"))
        with pytest.raises(MotionFailed, match="another") as refused:
            await cell.arm.move("home")
        assert refused.value.code == "stopped"
        with pytest.raises(MotionFailed, match="another"):
            await cell.gripper.open()

    run(program)


def test_jog_of_a_program_that_was_held_up_says_that_its_words_came_too_late(monkeypatch: pytest.MonkeyPatch) -> None:
    async def program(cell: Cell) -> None:
        async def hold_up() -> None:
            while not (await cell.arm.owner_now()).jogging:  # noqa: ASYNC110 - nothing else tells of it
                await asyncio.sleep(0.01)
            monkeypatch.setattr(arm, "JOG_PERIOD", 1.0)  # longer than the arm goes on without a word

        holding = asyncio.create_task(hold_up())
        with pytest.raises(JogFailed, match="nobody's; words of this program came too late"):
            await cell.arm.jog(linear=(0.0, 0.0, 0.05), seconds=10.0)
        await holding
        assert np.abs(await cell.arm.velocities()).max() < 1e-3

    run(program)


def test_stop_of_ones_own_that_comes_while_a_motion_is_planned_keeps_the_arm() -> None:
    async def program(cell: Cell) -> None:
        before, plan = await cell.arm.joints(), cell.arm._motion.plan

        async def stopped_meanwhile(*goal: Any, **more: Any) -> Any:
            found = await plan(*goal, **more)
            await Cell.on(cell.bus, owner="program").arm.stop("wait")  # the same person, in another terminal
            return found

        cell.arm._motion.plan = stopped_meanwhile  # type: ignore[method-assign]
        with pytest.raises(MotionFailed, match="wait") as refused:
            await cell.arm.move(pose(0.45, 0.1, 0.4))
        assert refused.value.code == "stopped"
        assert "wait" in (await cell.arm.status()).stopped
        assert np.allclose(await cell.arm.joints(), before, atol=1e-6)

    run(program)


def test_hold_keeps_a_motion_on_its_path_until_it_is_released() -> None:
    async def program(cell: Cell) -> None:
        moving = asyncio.create_task(cell.arm.move(pose(0.4, 0.4, 0.3), speed=0.2))
        await until_moving(cell)
        await cell.arm.hold("somebody comes")
        await asyncio.sleep(1.0)
        where = await cell.arm.joints()
        await asyncio.sleep(0.5)
        assert np.allclose(await cell.arm.joints(), where, atol=1e-6) and not moving.done()
        await cell.arm.release()
        assert (await moving).state == "succeeded"

    run(program)


def test_motion_that_is_owned_is_nobody_elses_until_the_block_ends() -> None:
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


def test_motion_that_is_owned_is_not_given_back_by_a_block_within() -> None:
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
            await asyncio.sleep(2.0)  # as a program that hangs
            assert (await cell.arm.owner_now()).kind == "none"

    run(program)


@pytest.mark.parametrize("after", [0.0, 0.001, 0.002, 0.01])
def test_whoever_is_cancelled_while_taking_the_motion_does_not_keep_it(after: float) -> None:
    async def program(cell: Cell) -> None:
        async def own() -> None:
            async with cell.arm.owned():
                await asyncio.sleep(5.0)

        owning = asyncio.create_task(own())
        await asyncio.sleep(after)
        owning.cancel()
        with pytest.raises(asyncio.CancelledError):
            await owning
        await asyncio.sleep(0.05)  # in which the executor tells
        assert (await cell.arm.owner_now()).kind == "none"

    run(program)


def test_jogging_moves_as_long_as_it_is_asked_for_and_no_longer() -> None:
    async def program(cell: Cell) -> None:
        before = await cell.arm.pose()
        await cell.arm.jog(linear=(0.0, 0.1, 0.0), seconds=1.0)
        await asyncio.sleep(0.5)
        after = await cell.arm.pose()
        moved = after[:3, 3] - before[:3, 3]
        for seconds in (0.01, 0.1, 0.2):
            await cell.arm.jog(linear=(0.0, -0.1, 0.0), seconds=seconds)
            assert not (await cell.arm.owner_now()).jogging
        await cell.arm.move("home")  # it rests when jogging returns
        assert 0.03 < moved[1] < 0.11 and abs(moved[0]) < 5e-3 and abs(moved[2]) < 5e-3
        assert np.abs(await cell.arm.velocities()).max() < 1e-3
        with pytest.raises(UnknownName, match="elbow"):
            await cell.arm.jog(joints={"elbow": 0.1})
        with pytest.raises(ConfigError, match="60 s"):
            await cell.arm.jog(linear=(0.1, 0, 0), seconds=1e9)

    run(program)


def test_fingers_open_close_and_say_what_they_hold() -> None:
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


def test_pictures_come_as_arrays_with_the_camera_that_took_them() -> None:
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


def test_camera_is_asked_in_one_line_and_looked_up_then() -> None:
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


def test_objects_are_those_that_were_seen_and_the_world_is_edited_by_name() -> None:
    async def program(cell: Cell) -> None:
        seen, truth = await cell.objects(least=2), await cell.world.objects()
        assert len(seen) == len(truth) == 2 and all(each.role == "target" for each in seen)
        for each in truth:
            nearest = min(seen, key=lambda found: np.hypot(
                found.pose.position.x - each.pose.position.x, found.pose.position.y - each.pose.position.y))
            assert nearest.pose.position.x == pytest.approx(each.pose.position.x, abs=0.01)
        with pytest.raises(NothingReceived, match="of 3 objects, but of 2"):
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
        for value in (np.int64(7), np.float32(8), np.array(9)):  # what is counted in pictures is
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


def test_task_is_started_heard_of_and_stopped() -> None:
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


def test_any_key_is_called_and_listened_to() -> None:
    async def program(cell: Cell) -> None:
        async for state in cell.listen("joint_states"):
            assert len(state.position) >= 7
            break
        answer = await cell.call("motion/hold", hold=True, owner="program")
        again = await cell.call(topics.MOTION_HOLD, HoldRequest(hold=True, owner="program"))
        assert answer.held and again.held and [each.by for each in again.interlocks] == ["program"]
        await cell.arm.release()
        for asked, error, words in (
            (cell.call("motion/hodl"), UnknownName, "motion/hold"),
            (cell.call("motion/hold", hodl=True), ConfigError, "hold"),
            (cell.call("motion/hold", hold=True, timeout=-1), ConfigError, "timeout"),
            (anext(cell.listen("motion/hold")), ConfigError, "is a request"),
            (anext(cell.listen("joint_state")), UnknownName, "did you mean 'joint_states'"),
            (anext(cell.listen("/joint_states", plain=True)), UnknownName, "did you mean 'joint_states'"),
        ):
            with pytest.raises(error, match=words):
                await asked
        with pytest.raises(NothingReceived, match="scene_object_updates"):
            async for _ in cell.listen("scene_object_updates", timeout=0.5):
                pass
        async for packed in cell.listen("joint_states", plain=True):
            assert len(packed["position"]) >= 7
            break
        for payload, heard in ((msgpack.packb({1: 2}), {1: 2}), (b"hello", DecodeError), (b"", DecodeError)):
            coming = asyncio.create_task(anext(cell.listen("others", plain=True)))
            await asyncio.sleep(0.1)  # of virtual time, in which it is listened to
            cell.bus.raw_writer(f"{cell.name}/others", "", "event").put(payload)
            if heard is DecodeError:
                with pytest.raises(DecodeError, match=r"panda/others: .* are not msgpack"):
                    await coming
            else:
                assert await coming == heard
        assert any(service.name == "motion_planner" for service in (await cell.services()).services)

    run(program)


def test_what_nobody_answers_ends_in_the_exception_that_says_so() -> None:
    async def program(cell: Cell) -> None:
        with pytest.raises(NoResponder, match="param/nobody"):
            await cell.call("param/nobody")
        with pytest.raises(NothingReceived, match="nobody/camera_info"):
            await cell._ear.newest(replace(topics.CAMERA_INFO, key="nobody/camera_info"))
        with pytest.raises(RemoteError, match="controller"):
            await cell.arm.order("enable")

    run(program, "ur5")


async def test_where_a_frame_was_when_it_was_last_told_of_is_not_where_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("common.client.frames.PATIENCE", 0.2)
    net = LocalNetwork()
    said, cell = net.bus("robot_state_publisher").writer(topics.TF), Cell.on(net.bus("program"))

    async def told(stamp: int, *names: str) -> None:
        for _ in range(50):
            await asyncio.sleep(0)
        said.put(TFMessage(transforms=[
            TransformStamped(header=Header(stamp=stamp, frame_id="world"), child_frame_id=name, transform=Pose(
                position=Vector3(x=float(stamp)))) for name in names]))

    for stamp in (1, 2):
        where = asyncio.create_task(cell.tf("world", "link"))
        await told(stamp, "link", "other")
        assert (await where)[0, 3] == stamp
    for _ in range(2):  # also when the other one goes on moving
        where = asyncio.create_task(cell.tf("world", "link"))
        await told(3, "other")
        with pytest.raises(NothingReceived, match="tf of link within"):
            await where
    shown = poses(cell.bus, "world", "link", 0.01)
    where = asyncio.create_task(anext(shown))
    await told(4, "link", "other")
    assert (await where)["position"][0] == 4
    with pytest.raises(NothingReceived, match="tf of link within"):
        while True:
            await told(5, "other")
            assert (await anext(shown))["position"][0] == 4


@pytest.mark.parametrize("owner", ["x" * 121, "two\nlines", 5])
def test_a_name_that_nobody_may_have_is_told_before_anything_is_asked_for(owner: Any) -> None:
    for made in (Cell, partial(Cell.start, "panda")):
        with pytest.raises(ConfigError, match="owner"):
            made(owner=owner)


async def test_a_cell_that_is_not_joined_says_how_to_join_it() -> None:
    cell = Cell("panda")
    for name in ("arm", "gripper", "task", "param", "world", "bus"):
        with pytest.raises(ZencellError, match="async with"):
            getattr(cell, name)
    with pytest.raises(ZencellError, match="async with"):
        cell.camera()
    with pytest.raises(AttributeError, match="amr"):
        _: Any = cell.amr


def test_slip_of_the_hand_is_told_and_changes_nothing() -> None:
    async def program(cell: Cell) -> None:
        for part, name, words in (
            (cell, "parm", "Cell.parm is not there: did you mean 'param'?"),
            (cell, "param", "Cell.param cannot be set"),
            (cell.arm, "speeed", "Arm.speeed is not there"), (cell.arm, "owner", "Arm.owner cannot be set"),
            (cell.gripper, "wdith", "Gripper.wdith"), (cell.task, "pausse", "did you mean 'pause'"),
            (cell.world, "ad", "'add'"), (cell.scene, "ad", "'add'"), (cell.param, "sett", "'set'"),
            (await cell.camera(), "imgae", "'image'"),
        ):
            with pytest.raises(ZencellError, match=re.escape(words)) as told:
                setattr(part, name, 3)
            assert "\n" not in str(told.value) and isinstance(told.value, AttributeError)
        assert cell.owner == cell.arm.owner == "program"
        await cell.objects(least=1)
        with pytest.raises(UnknownName, match=r"unknown object to touch 'track_l' \(did you mean 'track_\d'\?\)"):
            await cell.arm.plan("home", touch=["track_l"])
        await cell.arm.plan("home", touch="track_1")

    run(program)
