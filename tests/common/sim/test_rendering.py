"""Rendered images of the simulated world, plain and full: objects, fixtures, the arm, noise and caching."""

import math
from typing import Any

import msgpack
import numpy as np
import pytest

from common.config import CameraConfig, Container, Fixture, Surroundings, World
from common.errors import DecodeError
from common.messages import Color, Header, JointState, WorldObject, WorldObjects
from common.perception.pinhole import Pinhole, ray_distances, silhouette
from common.sim import rendering
from common.sim.objects import solid_of_message, world_object
from common.sim.rendering import ARM, Renderer, add_depth_noise
from common.transport.codec import decode
from tests.applications.outlining.outline_scenes import seen_world, world
from tests.common.planning.scenes import UR5 as ROBOT
from tests.common.sim.rig import SHAPES
from tests.common.sim.spheres import draw_spheres, spheres

TABLE = Fixture(id="table", dimensions=[1.0, 1.0, 0.05], position=(0.5, 0.0, -0.025), color=(0.55, 0.35, 0.1))
POST = Fixture(id="post", shape="cylinder", dimensions=[0.03, 0.3], position=(0.6, 0.2, 0.15), color=(1.0, 0.0, 1.0))
AROUND = Surroundings(fixtures=[TABLE, POST])
BALLS = Surroundings(container=Container())
CAMERA = Pinhole.from_config(CameraConfig())
BALL_RED = (1.0, 38 / 255, 26 / 255)
BLUE = (0.0, 0.25, 1.0)


def obj(shape: str, **values: Any) -> WorldObject:
    thing = {"id": "obj", "x": 0.45, "y": -0.1, "color": BLUE, **SHAPES[shape], **values}
    return world_object(World.model_validate({"objects": [thing]}).objects[0])


def is_color(image: Any, rgb: tuple[float, float, float], tolerance: int = 2) -> Any:
    bgr = np.round(255 * np.array(rgb[::-1])).astype(int)
    return (np.abs(image.astype(int) - bgr) <= tolerance).all(axis=2)


def red(image: Any) -> Any:
    return is_color(image, BALL_RED, 11)


def pixel(*point: float) -> tuple[int, int]:
    """Row and column of a point in world."""
    u, v = np.rint(CAMERA.project(point)).astype(int)
    return v, u


# --- plain images of spheres ---


def test_plain_table_is_grey_with_a_grid_and_the_projected_rim_of_the_container() -> None:
    image = draw_spheres([], CAMERA, BALLS)
    assert image.shape == (480, 640, 3) and image.dtype == np.uint8
    assert (image[300, 300] == 128).all() and (image[320, 301] == 108).all() and (image[301, 320] == 108).all()
    assert not red(image).any()
    v, u = np.nonzero((image[..., 2] > 200) & (image[..., 0] < 90))
    c = BALLS.container
    rim = CAMERA.project([(c.x + dx, c.y + dy, c.wall_height) for dx in (-0.08, 0.08) for dy in (-0.08, 0.08)])
    assert u.min() == pytest.approx(rim[:, 0].min(), abs=2) and v.min() == pytest.approx(rim[:, 1].min(), abs=2)
    assert u.max() < 320, "the container is at +y, left in the image"


def test_plain_sphere_covers_exactly_the_pixels_whose_rays_meet_it() -> None:
    center = np.array((0.6, -0.35, 0.03))
    v, u = np.nonzero(red(draw_spheres([center], CAMERA, BALLS)))
    distance, _ = ray_distances(CAMERA.directions(np.column_stack([u, v])), center[None] - CAMERA.position)
    assert distance.max() < 0.03
    outline = silhouette(CAMERA, center, 0.03, 400)
    area = 0.5 * abs(np.sum(outline[:, 0] * np.roll(outline[:, 1], 1) - outline[:, 1] * np.roll(outline[:, 0], 1)))
    assert area - 230 < len(u) < area - 90, "the white rim takes the outermost pixels"


def test_plain_sphere_has_its_color_and_a_white_rim_of_two_pixels() -> None:
    image = draw_spheres([(0.4, 0.0, 0.03)], CAMERA, BALLS, rim_width=2)
    whiteness = (image[245, 320:350].astype(float).min(axis=1) - 128).clip(0) / 127
    assert whiteness.sum() == pytest.approx(2, abs=0.3)
    blue = BALLS.model_copy(update={"ball_color": (0.0, 0.0, 1.0)})
    assert draw_spheres([(0.4, 0.1, 0.03)], CAMERA, blue)[pixel(0.4, 0.1, 0.03)].tolist() == [255, 0, 0]


def test_nearer_sphere_occludes_in_any_order_and_an_invisible_one_changes_nothing() -> None:
    low, high = (0.55, 0.25, 0.035), (0.55, 0.25, 0.095)
    one, other = (draw_spheres(order, CAMERA, BALLS) for order in ([low, high], [high, low]))
    np.testing.assert_array_equal(one, other)
    assert red(one)[pixel(*high)]
    beyond = [(2.0, 0, 0.03), (0.4, 0, 0.9), (0.4, 0, 0.79)]  # out of view, above the camera, around it
    np.testing.assert_array_equal(draw_spheres(beyond, CAMERA, BALLS), draw_spheres([], CAMERA, BALLS))


def test_unchanged_spheres_are_cached(monkeypatch: pytest.MonkeyPatch) -> None:
    computed = []
    original = rendering.sphere_coverage
    monkeypatch.setattr(rendering, "sphere_coverage", lambda *values: (computed.append(1), original(*values))[1])
    renderer, positions = Renderer(AROUND, plain=True), [(0.4, 0.1, 0.03), (0.45, 0.15, 0.03), (0.6, -0.2, 0.03)]
    renderer.render(spheres(positions, AROUND).objects)
    for moved in ((0.43, 0.14, 0.03), (0.43, 0.14, 0.05)):
        positions[0] = moved
        computed.clear()
        image = renderer.render(spheres(positions, AROUND).objects).colour
        assert len(computed) == 1
        fresh = Renderer(AROUND, plain=True).render(spheres(positions, AROUND).objects)
        np.testing.assert_array_equal(image, fresh.colour)


# --- noise ---


def test_noise_of_image_and_depth_has_the_configured_statistics() -> None:
    plain = draw_spheres([(0.4, 0, 0.03)], CAMERA, BALLS).astype(float)
    noisy, same = (draw_spheres([(0.4, 0, 0.03)], CAMERA, BALLS, noise_std=8, brightness=20,
                                rng=np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(noisy, same)
    background = (noisy.astype(float) - plain)[300:, :300]
    assert background.mean() == pytest.approx(20, abs=0.2) and background.std() == pytest.approx(8, abs=0.2)
    depth = np.full((200, 200), 1.5, np.float32)
    depth[0, 0] = np.nan
    noisy = add_depth_noise(depth, np.random.default_rng(1), 0.002, 0.1)
    assert np.isnan(noisy).mean() == pytest.approx(0.1, abs=0.01) and np.nanstd(noisy) == pytest.approx(0.002, rel=0.05)
    assert noisy.dtype == np.float32 and np.isnan(noisy[0, 0])
    np.testing.assert_array_equal(add_depth_noise(depth, np.random.default_rng(1), 0, 0), depth)


# --- objects of all shapes ---


@pytest.mark.parametrize("plain", [True, False])
@pytest.mark.parametrize("shape", ["box", "cylinder", "prism", "ring"])
def test_object_covers_its_projection(shape: str, plain: bool) -> None:
    shown = obj(shape, yaw=0.4)
    blue = is_color(Renderer(AROUND, plain=plain).render([shown]).colour, BLUE)
    R = np.array([[math.cos(0.4), -math.sin(0.4), 0], [math.sin(0.4), math.cos(0.4), 0], [0, 0, 1]])
    p = shown.pose.position
    pixels = CAMERA.project(solid_of_message(shown).triangles.reshape(-1, 3) @ R.T + (p.x, p.y, p.z))
    v, u = np.nonzero(blue)
    assert (u.min(), v.min()) == pytest.approx(tuple(pixels.min(axis=0)), abs=2)
    assert (u.max(), v.max()) == pytest.approx(tuple(pixels.max(axis=0)), abs=2)
    if shape != "prism":  # which has a corner there
        assert blue[pixel(0.45, -0.1, 0.0)] == (shape != "ring"), "a ring has a hole"


def test_nearer_object_occludes_regardless_of_shape() -> None:
    below, above = obj("box", size=[0.2, 0.2, 0.02]), spheres([(0.45, -0.1, 0.05)]).objects[0]
    top, renderer, red_ball = pixel(0.45, -0.1, 0.08), Renderer(AROUND, plain=True), (1.0, 0.15, 0.1)
    assert is_color(renderer.render([above, below]).colour, red_ball)[top]
    lifted = renderer.render([above, obj("box", size=[0.2, 0.2, 0.02], z=0.2)]).colour
    assert is_color(lifted, BLUE)[top] and not is_color(lifted, red_ball).any()


def test_plain_images_hide_held_objects_and_the_color_of_the_table() -> None:
    held, top = obj("box").model_copy(update={"state": "held"}), pixel(0.6, 0.2, 0.3)
    for plain in (True, False):
        image = Renderer(AROUND, plain=plain).render([held]).colour
        assert is_color(image, POST.color)[top]
        assert is_color(image, TABLE.color).any() != plain and is_color(image, BLUE).any() != plain


def test_depth_of_an_object_is_that_of_its_top() -> None:
    view = Renderer(AROUND).render([obj("cylinder", height=0.08)])
    assert view.depth[pixel(0.45, -0.1, 0.08)] == pytest.approx(0.8 - 0.08, abs=1e-4)
    assert view.depth[10, 10] == pytest.approx(0.8, abs=1e-4)


def test_changed_object_is_rendered_again_and_old_shapes_leave_the_cache() -> None:
    renderer = Renderer(AROUND, plain=True)
    first = renderer.render([obj("box")]).colour
    assert (renderer.render([obj("box", yaw=0.5)]).colour != first).any()
    green = obj("box").model_copy(update={"color": Color(r=0, g=1, b=0)})
    assert is_color(renderer.render([green]).colour, (0.0, 1.0, 0.0)).any()
    np.testing.assert_array_equal(renderer.render([obj("box")]).colour, first)
    for k in range(4):
        renderer.render([obj("box", size=[0.05, 0.05, 0.02 + 0.001 * k])])
    assert renderer.cached_shapes == 1


@pytest.mark.parametrize("shape", ["box", "cylinder", "prism", "ring"])
def test_object_of_an_old_recording_gets_pose_and_size(shape: str) -> None:
    now = obj(shape, yaw=0.4, z=0.1)
    before = WorldObject.model_validate({
        "id": "obj", "shape": shape, "outline": now.outline, "hole": now.hole, "base": now.base,
        "height": now.height, "color": now.color})
    one, other = (Renderer(AROUND, plain=True).render([message]).colour for message in (now, before))
    assert (one != other).any(axis=2).mean() < 1e-4 and before.size.z == pytest.approx(now.size.z)


@pytest.mark.parametrize("wrong", [
    {"shape": "mesh"}, {"shape": "mesh", "vertices": [(0.0, 0.0, 0.0)] * 3},
    {"shape": "mesh", "vertices": [(0.0, 0.0, 0.0)] * 3, "triangles": [(0, 1, 3)]},
    {"shape": "mesh", "vertices": [(0.0, 0.0, 0.0)] * 3, "triangles": [(0, 1, -1)]},
    {"shape": "prism"}, {"shape": "prism", "polygon": [(0.0, 0.0), (1.0, 0.0)]},
])
def test_object_without_a_valid_shape_is_rejected(wrong: dict[str, Any]) -> None:
    with pytest.raises(DecodeError, match=r"WorldObjects\.objects\.0"):
        decode(WorldObjects, msgpack.packb({"objects": [{"id": "a", **wrong}]}))


# --- the arm ---

UR5_WORLD = Surroundings.model_validate({f: getattr(world("w5"), f) for f in Surroundings.model_fields})
OBJECTS = [world_object(o) for o in world("w5").objects]
OVER = [0.1, -1.3, 1.6, -1.87, -1.57, 0.1]  # the gripper above the objects
AT_HOME = ROBOT.named("home")


@pytest.fixture(scope="module")
def renderer() -> Renderer:
    return Renderer(UR5_WORLD, ROBOT)


def joints(positions: Any) -> JointState:
    return JointState(header=Header(), name=ROBOT.joint_names[: len(positions)], position=list(positions))


def is_arm(view: Any) -> Any:
    return (np.abs(view.colour.astype(int) - round(255 * ARM[0])) <= 1).all(axis=2)


def test_arm_is_rendered_at_its_kinematic_pose_and_hides_no_object_at_home(renderer: Renderer) -> None:
    home = renderer.render(OBJECTS, joints(AT_HOME))
    assert not is_arm(home).any()
    np.testing.assert_array_equal(home.colour, seen_world("w5")[1])
    view = renderer.render(OBJECTS, joints(OVER))
    arm = is_arm(view)
    assert arm.any() and view.depth[arm].max() < 1.75
    wrist = ROBOT.link_poses(OVER)["wrist_3_link"][:3, 3]
    u, v = np.rint(renderer.camera.project(wrist)).astype(int)
    assert arm[v, u] and view.depth[v, u] == pytest.approx(2.75 - wrist[2], abs=0.12)


def test_unchanged_scene_returns_the_same_view_and_an_incomplete_joint_state_shows_no_arm(renderer: Renderer) -> None:
    first = renderer.render(OBJECTS, joints(AT_HOME))
    assert renderer.render(OBJECTS, joints(AT_HOME + 1e-6)) is first
    assert renderer.render(OBJECTS, joints(OVER)) is not first
    assert (renderer.render(OBJECTS[:1], joints(AT_HOME)).colour != first.colour).any()
    for state in (joints(OVER[:3]), None):
        assert not is_arm(renderer.render(OBJECTS, state)).any()
