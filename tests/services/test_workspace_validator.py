import numpy as np
import pytest

from applications.pick_place.topics import DETECTED_OBJECTS, REJECTED_TARGETS, VALIDATED_TARGETS, WORKSPACE_MARKERS
from common import topics
from common.config import Grasp, Surroundings, load_cell
from common.messages import Header, Marker, MarkerArray, ParameterRequest, Vector3
from common.perception.pinhole import Pinhole
from services import workspace_validator
from tests.services.fake_cell import FakeCell, at, settle, until

AROUND = Surroundings()
CAMERA = Pinhole.from_config(AROUND.camera)
CONFIG = workspace_validator.Config(world=AROUND, robot=load_cell("panda").robot, grasp=Grasp())
BAD, GOOD = (0.05, 0.0, 0.03), (0.5, 0.0, 0.03)


def detections(*places, stamp=1_000, partial=(), pixel=True):
    """Return detections at places (x, y, z), projected on the plane of the table as the detector does."""
    markers = []
    for index, place in enumerate(places):
        uv = CAMERA.project(place)
        markers.append(Marker(
            ns="ball", id=index, type="sphere", pose=at(*CAMERA.on_plane(uv, 0.03), 0.03),
            scale=Vector3(x=0.06, y=0.06, z=0.06), partial=index in partial,
            pixel=(float(uv[0]), float(uv[1])) if pixel else None))
    return MarkerArray(header=Header(stamp=stamp, frame_id="world"), markers=markers)


class Cell(FakeCell):
    def __init__(self):
        super().__init__()
        self.targets, self.rejected = self.reader(VALIDATED_TARGETS), self.reader(REJECTED_TARGETS)

    async def answer(self, frame, count):
        """Publish detections and return their answer, which has so many targets."""
        self.put(DETECTED_OBJECTS, frame)
        stamp = frame.header.stamp
        return await until(self.targets, lambda found: found.header.stamp == stamp and len(found.poses) == count)

    async def reasons(self, count):
        reported = []
        while len(reported) < count:
            reported += (await until(self.rejected)).rejected
        return [one.reason for one in reported]


@pytest.fixture
async def cell():
    made = Cell()
    made.calibrate(CAMERA, AROUND.camera.frame)
    made.config = CONFIG.model_copy()
    async with made.running(workspace_validator, made.config):
        yield made


async def test_targets_have_the_stamp_and_positions_of_the_detections(cell):
    places = [(0.5, -0.2, 0.03), (0.4, 0.05, 0.03)]
    found = await cell.answer(detections(*places, stamp=77), 2)
    assert found.header == Header(stamp=77, frame_id="world")
    np.testing.assert_allclose([(p.position.x, p.position.y, p.position.z) for p in found.poses], places)
    assert all(pose.orientation.w == 1 for pose in found.poses)
    await cell.answer(detections((0.55, 0.25, 0.035), GOOD, pixel=False, stamp=78), 1)
    assert (await cell.answer(detections(stamp=79), 0)).poses == [], "an empty table is published"


async def test_each_kind_of_rejection_has_its_reason(cell):
    places = [(0.05, 0.0, 0.03), (0.12, 0.1, 0.03), (0.70, -0.44, 0.03), (0.2, 0.0, 0.03), (0.45, 0.47, 0.03)]
    for stamp in (1_000, 3 * 10**8, 6 * 10**8):  # one at the border counts once it stays there: it is not carried
        await cell.answer(detections(*places, (0.5, -0.2, 0.03), partial={4}, stamp=stamp), 1)
    reasons = await cell.reasons(5)
    starts = ("singularity column", "too close", "too far", "pre-grasp at", "partly out of view")
    assert sorted(next(s for s in starts if reason.startswith(s)) for reason in reasons) == sorted(starts)


async def test_rejected_position_is_published_and_logged_once_and_none_in_the_container(cell, caplog):
    caplog.set_level("INFO")
    c = AROUND.container
    await cell.answer(detections((c.x, c.y, 0.035), GOOD, stamp=10**7), 1)
    assert cell.rejected.received == 0
    for stamp in range(1, 8):
        moved = (BAD[0] + 0.001 * (stamp % 2), 0.0, 0.03)
        await cell.answer(detections(moved, GOOD, stamp=stamp * 10**8), 1)
    assert len(await cell.reasons(1)) == cell.rejected.received == 1
    assert caplog.text.count("singularity column") == 1


async def test_detections_before_camera_info_are_dropped():
    cell = Cell()
    async with cell.running(workspace_validator, CONFIG):
        cell.put(DETECTED_OBJECTS, detections(GOOD, stamp=1))
        await settle()
        cell.calibrate(CAMERA, AROUND.camera.frame)
        cell.put(DETECTED_OBJECTS, detections(GOOD, stamp=2))
        first = await until(cell.targets)  # on a busy machine without the position that is still being computed
        assert first.header.stamp == 2


async def test_bounds_changed_live_affect_targets_and_markers(cell):
    shells = cell.reader(WORKSPACE_MARKERS)
    await cell.answer(detections((0.55, 0.0, 0.03)), 1)
    parameters = cell.client(topics.parameters_of("workspace_validator"))
    await parameters.call(ParameterRequest(set={"services.workspace_validator.max_radius": 0.5}, by="a test"))
    await until(shells, lambda message: message.markers[0].scale.x == 1.0)
    await cell.answer(detections((0.55, 0.0, 0.03), stamp=2_000), 0)
    assert "too far" in (await cell.reasons(1))[0]


async def test_late_subscriber_gets_shell_and_column(cell):
    message = await until(cell.net.bus().reader(WORKSPACE_MARKERS))
    shell, column = message.markers
    assert message.header.frame_id == "world" and shell.type == column.type == "cylinder"
    assert (shell.scale.x, column.scale.x) == (2 * 0.82, 2 * 0.18)
    assert shell.scale.z == column.scale.z == pytest.approx(1.03) and shell.pose.position.z == pytest.approx(0.465)
    assert 0 < shell.color.a < 0.5 and 0 < column.color.a < 0.5


async def test_frame_with_too_many_detections_is_dropped_and_reported(cell):
    log = cell.reader(topics.LOG)
    await cell.answer(detections(GOOD), 1)
    crowd = [(0.35 + 0.006 * (k % 20), -0.3 + 0.006 * (k // 20), 0.03) for k in range(300)]
    cell.put(DETECTED_OBJECTS, detections(*crowd, stamp=2_000))
    line = "frame of detections skipped: 300 objects in it are more than"
    await until(log, lambda logged: logged.message.startswith(line))
    await cell.answer(detections(GOOD, stamp=3_000), 1)
