import cv2
import numpy as np
import pytest

from common.config import CameraConfig, Scenery, load_cell
from common.errors import ConfigError
from common.messages import Header, JointState, WorldObjects
from common.perception.pinhole import Pinhole
from common.sim.camera import CameraParameters, Lens, ObjectMotion, SimulatedCamera, joints_ago
from tests.common.sim.spheres import spheres

BARREL = [-0.25, 0.08, 0.001, -0.0005, 0.0]
BENT = CameraConfig(d=BARREL)
CELL = load_cell("panda")


def spot(camera, place):
    """A picture of a small blurred dot where a camera without distortion sees a place."""
    u, v = camera.project(place)
    y, x = np.mgrid[0:camera.height, 0:camera.width]
    dot = 255 * np.exp(-((x - u) ** 2 + (y - v) ** 2) / 18)
    return np.repeat(np.rint(dot)[..., None], 3, axis=2).astype(np.uint8)


def middle(picture):
    weights = picture[..., 0].astype(float)
    y, x = np.mgrid[0:weights.shape[0], 0:weights.shape[1]]
    return np.array([(x * weights).sum(), (y * weights).sum()]) / weights.sum()


@pytest.fixture(scope="module")
def lens():
    return Lens(BENT, distorted=True)


@pytest.mark.parametrize("place", [(0.4, 0.0, 0.0), (0.68, 0.38, 0.0), (0.15, -0.4, 0.0)])
def test_lens_distortion_matches_opencv_and_the_rectified_image_a_pinhole(lens, place):
    plain = Pinhole.from_config(BENT)
    distorted = lens.distort(spot(Pinhole.from_config(lens.rendered), place))
    k = np.array([[520, 0, 320], [0, 520, 240], [0, 0, 1.0]])
    expected, _ = cv2.projectPoints(plain.to_camera(place)[None], np.zeros(3), np.zeros(3), k, np.array(BARREL))
    np.testing.assert_allclose(middle(distorted), expected.ravel(), atol=0.1)
    np.testing.assert_allclose(middle(lens.rectify(distorted)), plain.project(place), atol=0.1)
    assert lens.d == [0.0] * 5


def test_rendered_image_covers_the_lens_field_of_view(lens):
    assert 640 < lens.rendered.width < 1000 and 480 < lens.rendered.height < 800 and not lens.rendered.d
    white = np.full((lens.rendered.height, lens.rendered.width, 3), 200, np.uint8)
    assert lens.distort(white).min() == 200, "no black corners"


def test_lens_without_distortion_returns_the_same_image():
    picture = np.zeros((480, 640, 3), np.uint8)
    for lens in (Lens(BENT), Lens(CameraConfig(), distorted=True)):
        assert lens.distort(picture) is picture and lens.rectify(picture) is picture


def test_extreme_distortion_is_rejected():
    with pytest.raises(ConfigError, match=r"world\.camera\.d"):
        Lens(CameraConfig(d=[-1.5, 0.0]), distorted=True)


def sphere(x, stamp):
    return WorldObjects(header=Header(stamp=stamp), objects=spheres([(x, 0.0, 0.03)]).objects)


def test_moving_object_is_extrapolated_back_within_the_exposure():
    movement = ObjectMotion()
    for number in range(3):
        movement.update(sphere(0.4 + 0.01 * number, 100_000_000 * number))  # 0.1 m/s, at ten pictures a second
    now = 200_000_000
    for ago, stamp, x in ((0.02, now, 0.418), (0.0, now, 0.42), (0.02, now + 500_000_000, 0.42)):  # the last is too old
        assert movement.objects(ago, stamp)[0].pose.position.x == pytest.approx(x)


def test_repositioned_object_has_no_velocity():
    movement = ObjectMotion()
    movement.update(sphere(0.0, 0))
    movement.update(sphere(0.6, 50_000_000))
    assert movement.objects(0.02, 50_000_000)[0].pose.position.x == pytest.approx(0.6)


def test_joints_are_extrapolated_back_by_their_velocities():
    state = JointState(header=Header(), name=["a", "b"], position=[1.0, 2.0], velocity=[0.5, 0.0])
    assert joints_ago(state, 0.1).position == pytest.approx([0.95, 2.0]) and joints_ago(state, 0.0) is state


def camera(config: CameraParameters):
    return SimulatedCamera(CELL.world, Scenery(), [CELL.robot], config, np.random.default_rng(0), plain=True)


def test_motion_blur_equals_the_motion_within_the_exposure():
    def height(sub_exposures: int) -> int:
        """Of the picture of a sphere that moves by 2 m/s along x [px]."""
        one = camera(CameraParameters(sub_exposures=sub_exposures))
        table = one.capture(WorldObjects(), [None], 0).colour.astype(int)
        one.capture(sphere(0.40, 0), [None], 0)
        picture = one.capture(sphere(0.56, 80_000_000), [None], 80_000_000).colour.astype(int)
        changed = np.argwhere(np.abs(picture - table).max(axis=2) > 8)
        return np.ptp(changed[np.abs(changed[:, 1] - 320) < 3][:, 0])

    assert height(5) - height(1) == pytest.approx(2 * 0.01 * 520 / 0.77, abs=3)


def test_changed_light_affects_the_next_image():
    config = CameraParameters()
    one = camera(config)
    bright = one.capture(WorldObjects(), [None], 0).colour
    config.ambient = 20.0
    assert one.capture(WorldObjects(), [None], 0).colour.mean() == pytest.approx(bright.mean() * 370 / 500, rel=0.02)


def test_pose_error_moves_the_image_but_not_the_configured_pose():
    """The camera looks down from 0.8 m: 10 mm along its x axis and 20 mrad about it each move the picture."""
    def middle(*error: float) -> np.ndarray:
        """Of the picture of a sphere [px]."""
        one = camera(CameraParameters(pose_error=error))
        table = one.capture(WorldObjects(), [None], 0).colour.astype(int)
        picture = one.capture(sphere(0.40, 0), [None], 0).colour.astype(int)
        return np.argwhere(np.abs(picture - table).max(axis=2) > 8).mean(axis=0)[::-1]

    exact = middle(0, 0, 0, 0, 0, 0)
    assert middle(0.01, 0, 0, 0, 0, 0) - exact == pytest.approx((-520 * 0.01 / 0.77, 0), abs=0.7)
    assert middle(0, 0, 0, 0.02, 0, 0) - exact == pytest.approx((0, 520 * 0.02), abs=0.7)
    assert CELL.world.camera.position == (0.40, 0.0, 0.80)
