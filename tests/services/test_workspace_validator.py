import asyncio
import logging

import numpy as np
import pytest

from applications.pick_place.topics import (
    DETECTED_OBJECTS,
    REJECTED_TARGETS,
    VALIDATED_TARGETS,
    WORKSPACE_MARKERS,
)
from common import topics
from common.config import Grasp, Surroundings, load_cell
from common.messages import Header, Marker, MarkerArray, Pose, TFMessage, TransformStamped, Vector3
from common.perception.pinhole import Pinhole
from common.process.in_process import running_service
from common.robot.transforms import matrix_to_pose
from common.supervision.wiring import wiring
from common.transport.local import LocalNetwork
from services.workspace_validator import Config, run

around = Surroundings()
camera = Pinhole.from_config(around.camera)
config = Config(world=around, robot=load_cell("panda").robot, grasp=Grasp())
FRAME = around.camera.frame


def seen(*places, stamp=1_000, partial=(), pixel=True):
    """Detections at places (x, y, z): reported on the plane of the table, as the detector does."""
    made = []
    for index, place in enumerate(places):
        uv = camera.project(place)
        x, y = camera.on_plane(uv, 0.03)
        made.append(
            Marker(
                ns="ball", id=index, type="sphere", pose=Pose(position=Vector3(x=x, y=y, z=0.03)),
                scale=Vector3(x=0.06, y=0.06, z=0.06), partial=index in partial,
                pixel=(float(uv[0]), float(uv[1])) if pixel else None,
            )
        )
    return MarkerArray(header=Header(stamp=stamp, frame_id="world"), markers=made)


class Rig:
    def __init__(self, net, *, calibrated=True):
        bus = net.bus()
        self.found = bus.writer(DETECTED_OBJECTS)
        self.infos, self.statics = bus.writer(topics.CAMERA_INFO), bus.writer(topics.TF_STATIC)
        self.targets = bus.reader(VALIDATED_TARGETS)
        self.rejected = bus.reader(REJECTED_TARGETS)
        self.markers = bus.reader(WORKSPACE_MARKERS)
        if calibrated:
            self.calibrate()

    def calibrate(self):
        self.infos.put(camera.info(Header(frame_id=FRAME)))
        T = matrix_to_pose(camera.T_world_optical)
        header = Header(frame_id="world")
        self.statics.put(TFMessage(transforms=[TransformStamped(header=header, child_frame_id=FRAME, transform=T)]))

    async def answer(self, frame, count):
        """The answer to a frame once it has that many targets."""
        self.found.put(frame)
        while True:
            message = await asyncio.wait_for(self.targets.next(), 10)
            if message.header.stamp == frame.header.stamp and len(message.poses) == count:
                return message

    async def reasons(self, count):
        reported = []
        while len(reported) < count:
            reported += (await asyncio.wait_for(self.rejected.next(), 10)).rejected
        return [one.reason for one in reported]


async def test_detections_in_targets_out_under_the_same_stamp():
    net = LocalNetwork()
    rig = Rig(net)
    async with running_service(net, run, config, name="workspace_validator"):
        message = await rig.answer(seen((0.5, -0.2, 0.03), (0.4, 0.05, 0.03), stamp=77), 2)
    assert message.header == Header(stamp=77, frame_id="world")
    np.testing.assert_allclose(
        [(p.position.x, p.position.y, p.position.z) for p in message.poses], [(0.5, -0.2, 0.03), (0.4, 0.05, 0.03)]
    )
    assert all(pose.orientation.w == 1 for pose in message.poses)


async def test_each_kind_of_rejection_has_its_reason():
    net = LocalNetwork()
    rig = Rig(net)
    places = [(0.05, 0.0, 0.03), (0.12, 0.1, 0.03), (0.70, -0.44, 0.03), (0.2, 0.0, 0.03), (0.45, 0.47, 0.03)]
    async with running_service(net, run, config, name="workspace_validator"):
        await rig.answer(seen(*places, (0.5, -0.2, 0.03), partial={4}), 1)
        reasons = await rig.reasons(5)
    starts = ("singularity column", "too close", "too far", "pre-grasp at", "partly out of view")
    assert sorted(next(s for s in starts if reason.startswith(s)) for reason in reasons) == sorted(starts)


async def test_rejected_position_is_published_and_logged_once(caplog):
    net = LocalNetwork()
    rig = Rig(net)
    with caplog.at_level(logging.INFO):
        async with running_service(net, run, config, name="workspace_validator"):
            for stamp in range(1, 8):
                jitter = 0.001 * (stamp % 2)
                await rig.answer(seen((0.05 + jitter, 0.0, 0.03), (0.5, 0, 0.03), stamp=stamp * 10**8), 1)
            assert len(await rig.reasons(1)) == 1
            assert rig.rejected.received == 1
    assert len([r for r in caplog.records if "singularity column" in r.getMessage()]) == 1


async def test_object_put_back_later_is_reported_again():
    net = LocalNetwork()
    rig = Rig(net)
    bad, good = (0.05, 0.0, 0.03), (0.5, 0, 0.03)
    async with running_service(net, run, config, name="workspace_validator"):
        await rig.answer(seen(bad, good, stamp=10**9), 1)
        await rig.answer(seen(good, stamp=2 * 10**9), 1)
        await rig.answer(seen(bad, good, stamp=int(2.5 * 10**9)), 1)
        assert rig.rejected.received == 1
        await rig.answer(seen(good, stamp=5 * 10**9), 1)
        await rig.answer(seen(bad, good, stamp=6 * 10**9), 1)
        assert len(await rig.reasons(2)) == 2


async def test_balls_in_the_container_are_neither_targets_nor_rejections():
    net = LocalNetwork()
    rig = Rig(net)
    c = around.container
    boxed = [(c.x + dx, c.y + dy, z) for dx in (-0.033, 0.033) for dy in (-0.033, 0.033) for z in (0.035, 0.095)]
    async with running_service(net, run, config, name="workspace_validator"):
        await rig.answer(seen(*boxed, (0.5, -0.2, 0.03), partial={0}), 1)
        assert rig.rejected.received == 0


async def test_detections_without_a_pixel_are_validated_by_position():
    net = LocalNetwork()
    rig = Rig(net)
    async with running_service(net, run, config, name="workspace_validator"):
        await rig.answer(seen((0.55, 0.25, 0.035), (0.5, -0.2, 0.03), pixel=False), 1)


async def test_empty_table_is_published():
    net = LocalNetwork()
    rig = Rig(net)
    async with running_service(net, run, config):
        assert (await rig.answer(seen(stamp=5), 0)).poses == []


async def test_detections_before_camera_info_are_dropped():
    net = LocalNetwork()
    rig = Rig(net, calibrated=False)
    async with running_service(net, run, config):
        rig.found.put(seen((0.5, -0.2, 0.03), stamp=1))
        await asyncio.sleep(0.05)
        rig.calibrate()
        await rig.answer(seen((0.5, -0.2, 0.03), stamp=2), 1)
        assert rig.targets.latest.header.stamp == 2


async def test_late_subscriber_gets_shell_and_column():
    net = LocalNetwork()
    async with running_service(net, run, config, name="workspace_validator"):
        message = await asyncio.wait_for(Rig(net).markers.next(), 10)
    shell, column = message.markers
    assert message.header.frame_id == "world"
    assert shell.type == column.type == "cylinder"
    assert (shell.scale.x, column.scale.x) == (2 * 0.82, 2 * 0.18)
    assert shell.scale.z == column.scale.z == pytest.approx(1.03)
    assert shell.pose.position.z == pytest.approx(0.465)
    assert 0 < shell.color.a < 0.5 and 0 < column.color.a < 0.5


async def test_detector_reads_no_ground_truth():
    found = await wiring(run, config)
    assert found.reads == {DETECTED_OBJECTS, topics.CAMERA_INFO, topics.TF_STATIC, topics.JOINT_STATES}
    assert found.writes == {VALIDATED_TARGETS, REJECTED_TARGETS, WORKSPACE_MARKERS}


async def test_frame_with_too_many_detections_is_dropped_and_reported():
    net = LocalNetwork()
    rig, reported = Rig(net), asyncio.Queue()

    class Listening(logging.Handler):
        def emit(self, record):
            reported.put_nowait(record.getMessage())

    async with running_service(net, run, config, name="workspace_validator"):
        await rig.answer(seen((0.45, -0.2, 0.03)), 1)
        crowd = [(0.35 + 0.006 * (k % 20), -0.3 + 0.006 * (k // 20), 0.03) for k in range(300)]
        log, listening = logging.getLogger("workspace_validator"), Listening()
        log.addHandler(listening)
        rig.found.put(seen(*crowd, stamp=2_000))
        line = await asyncio.wait_for(reported.get(), 10)
        log.removeHandler(listening)
        assert line.startswith("frame of detections skipped: 300 objects in it are more than")
        await rig.answer(seen((0.45, -0.2, 0.03), stamp=3_000), 1)
