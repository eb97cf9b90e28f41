"""From a calibration to positions in the world: the cell uses the lens and pose found with the board."""

import cv2
import numpy as np
import pytest

from applications.pick_place.topics import DETECTED_OBJECTS
from cli.main import app
from common import topics
from common.config import load_cell, service_config
from common.perception.image import image_to_array
from common.robot.transforms import invert, rpy_to_matrix, transform
from services import camera_opencv, robot_state_publisher, vision_detector
from tests.services.fake_cell import FakeCell, name_of, until
from tests.tools.calibration.rendered_boards import BOARD, Lens, many_poses, render, through

LENS = Lens()
T_WORLD_CAMERA = transform(rpy_to_matrix(np.pi - 0.05, 0.04, -np.pi / 2 + 0.08), (0.41, -0.02, 0.82))
PLACES = {"near": (0.35, -0.15, 0.1), "far": (0.3, 0.15, 1.7)}  # of the board: x, y, yaw
BALLS = [(x, y, 0.03) for x, y in ((0.40, -0.30), (0.60, -0.20), (0.30, 0.0), (0.45, -0.05), (0.58, 0.05), (0.25, 0.3))]

CELL = """\
robot: panda
pipeline: lerp
task: none
world: {camera: camera.yaml, container: {x: 2.0}, count: 0}
services:
  robot_state_publisher: {}
  camera_opencv: {source: %s, rate: 20}
  vision_detector: {}
"""


@pytest.fixture(scope="module")
def cell(tmp_path_factory):
    """A cell whose camera was calibrated from pictures, and which looks at a table with balls."""
    root = tmp_path_factory.mktemp("calibrated")
    around = load_cell("panda", ["world.container.x=2"]).world
    pictures = {"views": [render(BOARD, LENS, T, seed=k) for k, T in enumerate(many_poses(BOARD, 10))],
                "table": [through(LENS, T_WORLD_CAMERA, around, BALLS)]}
    for name, (x, y, yaw) in PLACES.items():
        T_camera_board = invert(T_WORLD_CAMERA) @ transform(rpy_to_matrix(0, 0, yaw), (x, y, 0))
        pictures[name] = [render(BOARD, LENS, T_camera_board, seed=k) for k in range(3)]
    for name, images in pictures.items():
        (root / name).mkdir()
        for k, image in enumerate(images):
            cv2.imwrite(str(root / name / f"{k}.png"), image)
    file = str(root / "camera.yaml")
    assert app.execute(["calibrate", "intrinsics", str(root / "views"), "-o", file]) == 0
    positions = [word for x, y, _ in PLACES.values() for word in ("--board-position", f"{x},{y},0")]
    turns = [word for _, _, yaw in PLACES.values() for word in ("--board-rpy", f"0,0,{yaw}")]
    folders = [str(root / name) for name in PLACES]
    assert app.execute(["calibrate", "pose", *folders, "--intrinsics", file, *positions, *turns]) == 0
    (root / "cell.yaml").write_text(CELL % (root / "table"))
    return str(root / "cell.yaml")


@pytest.mark.slow
async def test_detection_through_a_distorted_lens_is_accurate_to_two_millimeters(cell):
    fake, loaded = FakeCell(), load_cell(cell)
    readers = [fake.reader(t) for t in (DETECTED_OBJECTS, topics.CAMERA_INFO, topics.CAMERA_IMAGE)]
    publisher, detector, camera = [fake.running(module, service_config(loaded, name_of(module), module.Config))
                                   for module in (robot_state_publisher, vision_detector, camera_opencv)]
    async with publisher, detector, camera:
        message, info, image = [await until(reader) for reader in readers]
    places = np.array([(m.pose.position.x, m.pose.position.y) for m in message.markers])
    assert len(places) == len(BALLS)
    off = [np.linalg.norm(places - ball[:2], axis=1).min() for ball in BALLS]
    assert max(off) < 2e-3, off
    assert not any(info.d) and info.k[0] == pytest.approx(LENS.fx, rel=2e-3)
    assert image_to_array(image).shape == (480, 640, 3)
