"""Rendered images of the simulated world, plain and full: objects, fixtures, the arm, noise and caching."""

from __future__ import annotations

import math
from typing import Any

import coal
import msgpack
import numpy as np
import pytest

from common.config import (
    CameraConfig,
    Container,
    Fixture,
    RobotConfig,
    Surroundings,
    World,
    check,
    find_file,
    read_robot,
)
from common.errors import ConfigError, DecodeError
from common.messages import Color, Header, JointState, WorldObject, WorldObjects
from common.perception.pinhole import Pinhole
from common.perception.sphere import ray_distances, silhouette
from common.robot.model import RobotModel
from common.sim import rendering
from common.sim.kinematic import KinematicWorld
from common.sim.layout import layout
from common.sim.objects import solid_of_message, world_object
from common.sim.rendering import ARM, Renderer, add_depth_noise
from common.sim.solids import robot_shapes, triangles
from common.transport.codec import decode
from tests.applications.outlining.outline_scenes import seen_world, world
from tests.common.sim.spheres import draw_spheres, spheres

TABLE = Fixture(id="table", dimensions=[1.0, 1.0, 0.05], position=(0.5, 0.0, -0.025), color=(0.55, 0.35, 0.1))
POST = Fixture(id="post", shape="cylinder", dimensions=[0.03, 0.3], position=(0.6, 0.2, 0.15), color=(1.0, 0.0, 1.0))
AROUND = Surroundings(fixtures=[TABLE, POST])
BALLS = Surroundings(container=Container())
CAMERA = Pinhole.from_config(CameraConfig())
BALL_RED = (1.0, 38 / 255, 26 / 255)
BLUE = (0.0, 0.25, 1.0)
L_SHAPE = [(-0.03, -0.03), (0.03, -0.03), (0.03, 0.0), (0.0, 0.0), (0.0, 0.03), (-0.03, 0.03)]
SHAPES: dict[str, dict[str, Any]] = {
    "box": {"shape": "box", "size": [0.06, 0.04, 0.03]},
    "cylinder": {"shape": "cylinder", "radius": 0.03, "height": 0.08},
    "prism": {"shape": "prism", "polygon": L_SHAPE, "height": 0.03},
    "ring": {"shape": "ring", "radius": 0.04, "inner_radius": 0.02, "height": 0.02},
}


def obj(**values: Any) -> WorldObject:
    config = World.model_validate({"objects": [{"id": "obj", "x": 0.45, "y": -0.1, "color": BLUE, **values}]})
    return world_object(config.objects[0])


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


def test_plain_table_is_grey_with_a_grid_every_40_pixels() -> None:
    image = draw_spheres([], CAMERA, BALLS)
    assert image.shape == (480, 640, 3) and image.dtype == np.uint8
    assert (image[300, 300] == 128).all() and (image[320, 301] == 108).all() and (image[301, 320] == 108).all()
    assert not red(image).any()


def test_plain_container_is_drawn_at_its_projected_rim() -> None:
    image = draw_spheres([], CAMERA, BALLS).astype(int)
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


def test_nearer_sphere_occludes_in_any_order() -> None:
    low, high = (0.55, 0.25, 0.035), (0.55, 0.25, 0.095)
    one, other = (draw_spheres(order, CAMERA, BALLS) for order in ([low, high], [high, low]))
    np.testing.assert_array_equal(one, other)
    assert red(one)[pixel(*high)]


def test_plain_sphere_has_a_white_rim_of_two_pixels() -> None:
    image = draw_spheres([(0.4, 0.0, 0.03)], CAMERA, BALLS, rim_width=2)
    profile = image[245, 320:350].astype(float)
    whiteness = (profile.min(axis=1) - 128).clip(0) / 127
    assert whiteness.sum() == pytest.approx(2, abs=0.3)


def test_invisible_sphere_changes_nothing() -> None:
    beyond = [(2.0, 0, 0.03), (0.4, 0, 0.9), (0.4, 0, 0.79)]  # out of view, above the camera, around it
    np.testing.assert_array_equal(draw_spheres(beyond, CAMERA, BALLS), draw_spheres([], CAMERA, BALLS))


def test_spheres_have_the_configured_color() -> None:
    blue = BALLS.model_copy(update={"ball_color": (0.0, 0.0, 1.0)})
    assert draw_spheres([(0.4, 0.1, 0.03)], CAMERA, blue)[pixel(0.4, 0.1, 0.03)].tolist() == [255, 0, 0]


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


def test_image_noise_and_brightness_have_the_configured_statistics() -> None:
    plain = draw_spheres([(0.4, 0, 0.03)], CAMERA, BALLS).astype(float)
    noisy, same = (draw_spheres([(0.4, 0, 0.03)], CAMERA, BALLS, noise_std=8, brightness=20,
                                rng=np.random.default_rng(1)) for _ in range(2))
    np.testing.assert_array_equal(noisy, same)
    background = (noisy.astype(float) - plain)[300:, :300]
    assert background.mean() == pytest.approx(20, abs=0.2) and background.std() == pytest.approx(8, abs=0.2)


def test_depth_noise_and_dropout_have_the_configured_statistics() -> None:
    depth = np.full((200, 200), 1.5, np.float32)
    depth[0, 0] = np.nan
    noisy = add_depth_noise(depth, np.random.default_rng(1), 0.002, 0.1)
    assert np.isnan(noisy).mean() == pytest.approx(0.1, abs=0.01) and np.nanstd(noisy) == pytest.approx(0.002, rel=0.05)
    assert noisy.dtype == np.float32 and np.isnan(noisy[0, 0])
    np.testing.assert_array_equal(add_depth_noise(depth, np.random.default_rng(1), 0, 0), depth)


# --- objects of all shapes ---


@pytest.mark.parametrize("plain", [True, False])
@pytest.mark.parametrize("shape", SHAPES)
def test_object_covers_its_projection(shape: str, plain: bool) -> None:
    shown = obj(**SHAPES[shape], yaw=0.4)
    blue = is_color(Renderer(AROUND, plain=plain).render([shown]).colour, BLUE)
    corners = solid_of_message(shown).triangles.reshape(-1, 3)
    R = np.array([[math.cos(0.4), -math.sin(0.4), 0], [math.sin(0.4), math.cos(0.4), 0], [0, 0, 1]])
    p = shown.pose.position
    pixels = CAMERA.project(corners @ R.T + (p.x, p.y, p.z))
    v, u = np.nonzero(blue)
    assert (u.min(), v.min()) == pytest.approx(tuple(pixels.min(axis=0)), abs=2)
    assert (u.max(), v.max()) == pytest.approx(tuple(pixels.max(axis=0)), abs=2)
    if shape != "prism":  # which has a corner there
        assert blue[pixel(0.45, -0.1, 0.0)] == (shape != "ring"), "a ring has a hole"


def test_nearer_object_occludes_regardless_of_shape() -> None:
    below, above = obj(shape="box", size=[0.2, 0.2, 0.02]), spheres([(0.45, -0.1, 0.05)]).objects[0]
    top, renderer, red_ball = pixel(0.45, -0.1, 0.08), Renderer(AROUND, plain=True), (1.0, 0.15, 0.1)
    assert is_color(renderer.render([above, below]).colour, red_ball)[top]
    lifted = renderer.render([above, obj(shape="box", size=[0.2, 0.2, 0.02], z=0.2)]).colour
    assert is_color(lifted, BLUE)[top] and not is_color(lifted, red_ball).any()


def test_fixtures_have_their_color_except_a_plain_table() -> None:
    top = pixel(0.6, 0.2, 0.3)
    plain, full = (Renderer(AROUND, plain=plain).render([]).colour for plain in (True, False))
    assert is_color(plain, POST.color)[top] and is_color(full, POST.color)[top]
    assert not is_color(plain, TABLE.color).any() and is_color(full, TABLE.color).any()


def test_held_object_is_hidden_in_plain_images_only() -> None:
    held = obj(**SHAPES["box"]).model_copy(update={"state": "held"})
    assert not is_color(Renderer(AROUND, plain=True).render([held]).colour, BLUE).any()
    assert is_color(Renderer(AROUND).render([held]).colour, BLUE).any()


def test_depth_of_an_object_is_that_of_its_top() -> None:
    view = Renderer(AROUND).render([obj(**SHAPES["cylinder"])])
    assert view.depth[pixel(0.45, -0.1, 0.08)] == pytest.approx(0.8 - 0.08, abs=1e-4)
    assert view.depth[10, 10] == pytest.approx(0.8, abs=1e-4)


def test_changed_color_or_rotation_is_rendered_again() -> None:
    renderer = Renderer(AROUND, plain=True)
    first = renderer.render([obj(**SHAPES["box"])]).colour
    assert (renderer.render([obj(**SHAPES["box"], yaw=0.5)]).colour != first).any()
    green = obj(**SHAPES["box"]).model_copy(update={"color": Color(r=0, g=1, b=0)})
    assert is_color(renderer.render([green]).colour, (0.0, 1.0, 0.0)).any()
    np.testing.assert_array_equal(renderer.render([obj(**SHAPES["box"])]).colour, first)


def test_cache_drops_shapes_that_are_no_longer_visible() -> None:
    renderer = Renderer(AROUND)
    for k in range(20):
        renderer.render([obj(shape="box", size=[0.05, 0.05, 0.02 + 0.001 * k])])
    assert renderer.cached_shapes == 1


@pytest.mark.parametrize("shape", SHAPES)
def test_object_of_an_old_recording_gets_pose_and_size(shape: str) -> None:
    now = obj(**SHAPES[shape], yaw=0.4, z=0.1)
    before = WorldObject.model_validate({
        "id": "obj", "shape": shape, "outline": now.outline, "hole": now.hole, "base": now.base,
        "height": now.height, "color": now.color})
    one, other = (Renderer(AROUND).render([message]).colour for message in (now, before))
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


def test_objects_without_a_position_are_placed_by_the_seed() -> None:
    described = [{"id": f"{shape}_{i}", **SHAPES[shape]} for shape in SHAPES for i in range(2)]
    config = World.model_validate({"fixtures": [TABLE], "containers": {"tray": {}}, "objects": described})
    found = layout(config, 3, lambda x, y, z: math.hypot(x, y) < 0.7)
    assert found == layout(config, 3, lambda x, y, z: math.hypot(x, y) < 0.7) != layout(config, 4, lambda x, y, z: True)
    assert [one.id for one in found] == [one["id"] for one in described]
    for one in KinematicWorld(config, found).objects(Header()).objects:
        assert one.state == "table" and math.hypot(one.pose.position.x, one.pose.position.y) < 0.75
    with pytest.raises(ConfigError, match=r"world\.objects: 8 objects fit no random layout"):
        layout(config, 3, lambda x, y, z: False)


# --- the arm ---

UR5_WORLD = Surroundings.model_validate({f: getattr(world("w5"), f) for f in Surroundings.model_fields})
OBJECTS = [world_object(o) for o in world("w5").objects]
OVER = [0.1, -1.3, 1.6, -1.87, -1.57, 0.1]  # the gripper above the objects


@pytest.fixture(scope="module")
def robot() -> RobotModel:
    return RobotModel.load(check(RobotConfig, read_robot(find_file("robots", "ur5"))))


@pytest.fixture
def renderer(robot: RobotModel) -> Renderer:
    return Renderer(UR5_WORLD, robot)


def joints(robot: RobotModel, positions: Any) -> JointState:
    return JointState(header=Header(), name=robot.joint_names, position=list(positions))


def is_arm(view: Any) -> Any:
    return (np.abs(view.colour.astype(int) - round(255 * ARM[0])) <= 1).all(axis=2)


def test_arm_at_home_occludes_no_object(renderer: Renderer, robot: RobotModel) -> None:
    view = renderer.render(OBJECTS, joints(robot, robot.named("home")))
    assert not is_arm(view).any()
    np.testing.assert_array_equal(view.colour, seen_world("w5")[1])


def test_arm_is_rendered_at_its_kinematic_pose(renderer: Renderer, robot: RobotModel) -> None:
    view = renderer.render(OBJECTS, joints(robot, OVER))
    arm = is_arm(view)
    assert arm.any() and view.depth[arm].max() < 1.75
    wrist = robot.link_poses(OVER)["wrist_3_link"][:3, 3]
    u, v = np.rint(renderer.camera.project(wrist)).astype(int)
    assert arm[v, u] and view.depth[v, u] == pytest.approx(2.75 - wrist[2], abs=0.12)


def test_unchanged_scene_returns_the_same_view(renderer: Renderer, robot: RobotModel) -> None:
    home = joints(robot, robot.named("home"))
    first = renderer.render(OBJECTS, home)
    assert renderer.render(OBJECTS, home.model_copy(update={"position": [p + 1e-6 for p in home.position]})) is first
    assert renderer.render(OBJECTS, joints(robot, OVER)) is not first
    assert (renderer.render(OBJECTS[:1], home).colour != first.colour).any()


def test_incomplete_joint_state_shows_no_arm(renderer: Renderer, robot: RobotModel) -> None:
    part = JointState(header=Header(), name=robot.joint_names[:3], position=OVER[:3])
    assert not is_arm(renderer.render(OBJECTS, part)).any() and not is_arm(renderer.render(OBJECTS, None)).any()


def test_link_shapes_come_from_the_urdf(robot: RobotModel) -> None:
    shapes = robot_shapes(robot)
    assert {"forearm_link", "wrist_3_link", "robotiq_85_base_link"} <= set(shapes)
    forearm = shapes["forearm_link"].reshape(-1, 3)
    assert np.ptp(forearm, axis=0).max() == pytest.approx(0.45, abs=0.1)


@pytest.mark.parametrize("shape, size", [
    (coal.Box(0.1, 0.2, 0.3), (0.1, 0.2, 0.3)), (coal.Sphere(0.1), (0.2, 0.2, 0.2)),
    (coal.Cylinder(0.1, 0.5), (0.2, 0.2, 0.5)), (coal.Capsule(0.1, 0.5), (0.2, 0.2, 0.7))])
def test_primitive_shapes_have_their_size(shape: Any, size: tuple[float, ...]) -> None:
    np.testing.assert_allclose(np.ptp(triangles(shape).reshape(-1, 3), axis=0), size, rtol=0.01)


def test_shapes_without_triangles_are_rejected() -> None:
    with pytest.raises(ValueError, match="no triangles for a Halfspace"):
        triangles(coal.Halfspace(np.array([0.0, 0, 1]), 0.0))
