"""The section of a report that shows each try."""

import base64
import re

import cv2
import numpy as np

from applications.sorting.report import MOST, SIDE, Tries
from applications.sorting.topics import GraspCandidate, Heap, SortingStatus
from common import messages as m
from common.config import CameraConfig
from common.perception.image import array_to_image
from common.perception.pinhole import Pinhole, camera_in_mount
from common.robot.transforms import matrix_to_pose, tool_down

CAMERA = CameraConfig(frame="eye", position=(0.53, 0.0, 0.95))
SCORE = 0.83


def grasp(name: str, x: float = 0.5) -> GraspCandidate:
    pose = matrix_to_pose(tool_down(x, 0.1, 0.03))
    return GraspCandidate(id=name, object="object_1", pose=pose, approach=pose, width=0.04, opening=0.06, score=SCORE)


def header(stamp: int) -> m.Header:
    return m.Header(stamp=stamp, frame_id="world")


def look(tries: Tries, stamp: int, grey: int, *grasps: GraspCandidate) -> None:
    pixels = np.full((CAMERA.height, CAMERA.width, 3), grey, np.uint8)
    tries.listeners()[m_topic("depth_camera/image_raw")](0.0, array_to_image(pixels, "bgr8", header(stamp)))
    tries.on_heap(Heap(header=header(stamp), at_home=True, grasps=list(grasps)))


def m_topic(key: str):  # noqa: ANN201
    return next(topic for topic in Tries().listeners() if topic.key == key)


def started() -> Tries:
    tries = Tries()
    tries.listeners()[m_topic("depth_camera/camera_info")](0.0, Pinhole.from_config(CAMERA).info(
        m.Header(stamp=1, frame_id="eye")))
    tries.on_transforms(m.TFMessage(transforms=[m.TransformStamped(
        header=header(1), child_frame_id="eye", transform=matrix_to_pose(camera_in_mount(CAMERA)))]))
    return tries


def pictures(html: str) -> list[np.ndarray]:
    return [cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
            for data in re.findall(r"base64,([^\"]+)", html)]


def test_try_has_the_picture_by_which_it_was_decided_and_the_first_one_after_it() -> None:
    tries = started()
    look(tries, 1, 60, grasp("a"), grasp("b", x=0.6))
    tries.on_status(5.0, SortingStatus(attempts=1, subject="object_1", grasp="b"))
    tries.on_gripper(m.GripperState(header=header(2), width=0.038, holding=True))
    tries.on_heap(Heap(header=header(2)))  # away from home
    tries.on_status(9.0, SortingStatus(attempts=1, held="one", last="placed in left"))
    look(tries, 3, 120)
    look(tries, 4, 200)
    section = tries.section()
    assert section is not None
    before, after = pictures(section.html)
    assert before.shape == after.shape == (SIDE, SIDE, 3)
    assert abs(int(np.median(before)) - 60) < 6 and abs(int(np.median(after)) - 120) < 6
    assert (before[..., 1].astype(int) - before[..., 2] > 80).sum() > 100, "the fingers are drawn in green"
    assert (after[..., 1].astype(int) - after[..., 2] > 80).sum() == 0
    for text in ("5.0", "object_1", "40 / 38", "0.83", "one", "placed in left"):
        assert f">{text}<" in section.html, text
    assert tries.tries[0].grasp is not None and tries.tries[0].grasp.id == "b"


def test_fingers_are_drawn_where_the_camera_sees_the_grasp() -> None:
    tries = started()
    look(tries, 1, 60, grasp("a"))
    tries.on_status(5.0, SortingStatus(attempts=1, subject="object_1", grasp="a"))
    (before,) = pictures(f'"{tries.tries[0].before}"')
    rows, columns = np.nonzero(before[..., 1].astype(int) - before[..., 2] > 60)
    apart = 0.06 * CAMERA.fx / (0.95 - 0.03)  # [px] of the image; fingers close along world y, across the image
    scale = SIDE / (2 * 0.13 * CAMERA.fx / (0.95 - 0.03))
    spread = max(np.ptp(rows), np.ptp(columns))
    assert apart * scale < spread < 1.3 * apart * scale + 4


def test_text_of_messages_is_escaped_and_the_number_of_tries_is_bounded() -> None:
    tries = started()
    for number in range(1, MOST + 4):
        tries.on_status(1.0 * number, SortingStatus(attempts=number, subject="<b>", last="<script>"))
    section = tries.section()
    assert section is not None and "<script>" not in section.html and "3 later tries" in section.html
    assert Tries().section() is None


def test_recording_without_camera_or_images_has_no_pictures() -> None:
    tries = Tries()
    tries.on_heap(Heap(header=header(1), at_home=True, grasps=[grasp("a")]))
    tries.on_status(5.0, SortingStatus(attempts=1, subject="object_1", grasp="a"))
    assert tries.tries[0].before == "" and "no picture" in (tries.section() or ("", "", ""))[2]
