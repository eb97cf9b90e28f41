import ctypes

import cv2
import numpy as np
import pytest

from common.config import CameraConfig, Scenery, load_cell
from common.config.world import Light
from common.messages import Color, Header, JointState, Pose, Vector3, WorldObject
from common.perception.pinhole import Pinhole
from common.robot.model import RobotModel
from common.sim.interface import load_renderer
from drivers.mujoco import gl
from drivers.mujoco.gl import select_gl
from drivers.mujoco.rendering import PhysicsRenderer

CELL = load_cell("panda")
ROBOT = RobotModel.load(CELL.robot)
GL = select_gl()
PLACES = [(0.40, 0.0, 0.03), (0.55, -0.20, 0.03), (0.30, 0.12, 0.03), (0.58, 0.10, 0.03)]
ABOVE = Light(position=(0.4, 0.0, 2.0), aim=(0.4, 0.0, 0.0))
ASIDE = Light(position=(0.4, 1.0, 1.0), aim=(0.4, 0.0, 0.0))

needs_gl = pytest.mark.skipif(not GL, reason="no OpenGL here: apt-get install libegl1 libgl1-mesa-dri libopengl0")
with_and_without_gl = pytest.mark.parametrize("gl", [pytest.param(GL, marks=needs_gl), ""])


def balls(places=PLACES, radius=0.03):
    size = Vector3(x=2 * radius, y=2 * radius, z=2 * radius)
    return [WorldObject(id=f"ball_{number}", shape="sphere", size=size, color=Color(r=1.0, g=0.15, b=0.1),
                        pose=Pose(position=Vector3(x=x, y=y, z=z))) for number, (x, y, z) in enumerate(places)]


def arm(**moved):
    """Return the home pose with joints moved by these angles [rad]."""
    position = ROBOT.named("home") + [moved.get(name, 0.0) for name in ROBOT.joint_names]
    locked = ROBOT.config.locked_joints
    return JointState(header=Header(), name=[*ROBOT.joint_names, *locked], position=[*position, *locked.values()])


AWAY = arm(panda_joint1=2.8)  # turned back, out of view


def camera(width=640, height=480, fx=520, fy=520, cx=319.5, cy=239.5):
    return Pinhole.from_config(CameraConfig(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy))


SMALL = camera(160, 120, 130, 130, 79.5, 59.5)


def drawn(objects, joints=AWAY, *, scenery=None, view=SMALL, gl=GL, world=CELL.world):
    scenery = scenery or Scenery(lights={"above": ABOVE})
    return PhysicsRenderer(world, scenery, [ROBOT], view, depth=True, gl=gl).render(objects, joints)


def red(picture):
    b, g, r = (picture[..., channel].astype(int) for channel in range(3))
    return (r > 60) & (r > 3 * g) & (r > 3 * b)


@needs_gl
def test_small_spheres_are_rendered_at_their_projection():
    view = camera()
    mask = red(drawn(balls(radius=0.01), view=view).colour)
    _, _, boxes, centres = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    assert len(boxes) == 1 + len(PLACES)
    for place in view.project(PLACES):
        assert np.linalg.norm(centres[1:] - place, axis=1).min() < 0.25


@with_and_without_gl
def test_non_square_pixels_and_off_center_axis_are_supported(gl):
    view = camera(160, 120, fx=150, fy=110, cx=70, cy=66)
    _, _, _, middles = cv2.connectedComponentsWithStats(red(drawn(balls(), view=view, gl=gl).colour).astype(np.uint8))
    for place in view.project(PLACES):
        assert np.linalg.norm(middles[1:] - place, axis=1).min() < 0.6


@with_and_without_gl
def test_depth_is_along_the_optical_axis(gl):
    view = drawn(balls(), gl=gl)
    for (x, y, z), (u, v) in zip(PLACES, SMALL.project(PLACES), strict=True):
        pixel = np.rint((u, v))
        origin, way = SMALL.ray(pixel)
        along = (np.array((x, y, z)) - origin) @ way
        distance = along - np.sqrt(along**2 - np.sum((np.array((x, y, z)) - origin) ** 2) + 0.03**2)
        expected = SMALL.to_camera(origin + distance * way)[2]
        assert view.depth[int(pixel[1]), int(pixel[0])] == pytest.approx(expected, abs=5e-4)
    assert view.depth[2, 2] == pytest.approx(0.80, abs=1e-4), "the table"


@needs_gl
def test_rays_and_opengl_agree_on_depth_and_colour():
    shown = Scenery(lights={"above": ABOVE.model_copy(update={"shadow": False})})
    one, other = (drawn(balls(), arm(), scenery=shown, gl=gl) for gl in (GL, ""))
    square = np.ones((3, 3), np.uint8)
    inner = cv2.dilate(other.depth, square) - cv2.erode(other.depth, square) < 0.01  # no edges
    assert inner.mean() > 0.7
    error = np.abs(one.depth - other.depth)[inner]
    assert np.mean(error > 1e-3) < 0.01
    different = np.abs(one.colour.astype(int) - other.colour).max(axis=2)[inner]
    assert np.mean(different > 40) < 0.05, "rays show no highlights, and facets instead of curved surfaces"


@with_and_without_gl
def test_arm_is_rendered_at_its_joint_positions(gl):
    home, away = drawn([], arm(), gl=gl), drawn([], AWAY, gl=gl)
    hidden = home.depth < 0.5
    assert 0.05 < hidden.mean() < 0.6 and not (away.depth < 0.5).any()
    moved = drawn([], arm(panda_joint1=0.2), gl=gl)
    assert (moved.depth < 0.5).any() and (hidden != (moved.depth < 0.5)).any()


@needs_gl
def test_objects_cast_shadows_away_from_the_light():
    shadow, none = (drawn(balls([(0.3, -0.2, 0.03)]), scenery=Scenery(lights={"aside": light})).colour
                    for light in (ASIDE, ASIDE.model_copy(update={"shadow": False})))
    dark = shadow.astype(int).sum(axis=2) < 0.7 * none.astype(int).sum(axis=2)
    where = SMALL.on_plane(np.argwhere(dark & ~red(none))[:, ::-1], 0.0)
    where = where[np.linalg.norm(where - (0.3, -0.2), axis=1) < 0.12]  # arm and container have shadows of their own
    assert len(where) > 10
    x, y = where.mean(axis=0)
    assert y < -0.22 and abs(x - 0.3) < 0.01, "the light comes from +y"


@needs_gl
def test_dimmed_and_warm_light_change_level_and_colors():
    bright, dim, warm = (
        PhysicsRenderer(CELL.world, Scenery(lights={"above": light}, ambient=0.2 * light.illuminance), [ROBOT], SMALL,
                        depth=False, gl=GL)
        for light in (ABOVE, ABOVE.model_copy(update={"illuminance": 35.0}),
                      ABOVE.model_copy(update={"temperature": 2700.0})))
    np.testing.assert_allclose(dim.level, bright.level / 10)
    assert warm.level[2] > bright.level[2] and warm.level[0] < 0.5 * bright.level[0]
    np.testing.assert_allclose(bright.render(balls(), AWAY).colour, dim.render(balls(), AWAY).colour, atol=2)


@needs_gl
def test_one_lamp_can_be_dimmed():
    lamps = {name: Light(position=(0.4, 3 * y, 1.0), aim=(0.4, y, 0.0), parallel=False, shadow=False)
             for name, y in (("left", 0.2), ("right", -0.2))}  # +y is left in the image
    renderer = PhysicsRenderer(CELL.world, Scenery(lights=lamps), [ROBOT], SMALL, depth=False, gl=GL)
    both = renderer.render([], AWAY).colour * renderer.level
    renderer.set_light(Scenery(lights=lamps | {"right": lamps["right"].model_copy(update={"illuminance": 20.0})}))
    one = renderer.render([], AWAY).colour * renderer.level
    left, right = slice(20, 40), slice(120, 140)
    assert one[:, right].mean() < 0.6 * both[:, right].mean() < one[:, left].mean()


@with_and_without_gl
def test_lamp_lights_only_its_cone(gl):
    low = Light(position=(0.4, 0.0, 0.25), aim=(0.4, 0.0, 0.0), parallel=False)
    picture = drawn([], gl=gl, scenery=Scenery(lights={"low": low}, ambient=50)).colour[..., 1]
    inside, outside = ((round(float(v)), round(float(u))) for u, v in SMALL.project(np.array([
        (0.4, -0.1, 0.0), (0.4, -0.35, 0.0)])))
    assert 0 < picture[outside] < 0.2 * picture[inside], "only ambient light"


def test_elsewhere_is_not_rendered_and_unchanged_scenes_are_cached():
    renderer = PhysicsRenderer(CELL.world, Scenery(), [ROBOT], SMALL, depth=False, gl="")
    things = balls()
    first = renderer.render(things, AWAY)
    assert renderer.render(list(things), AWAY) is first
    gone = [thing.model_copy(update={"state": "elsewhere"}) for thing in things]
    assert not red(renderer.render(gone, AWAY).colour).any() and red(first.colour).any()


@pytest.mark.parametrize("error", [ImportError, RuntimeError, AttributeError, ctypes.ArgumentError])
def test_failing_opengl_falls_back_to_ray_casting(monkeypatch, caplog, error):
    def broken(kind, width, height):
        raise error("no glGetError")

    monkeypatch.setattr(gl, "gl_context", broken)
    renderer = PhysicsRenderer(CELL.world, Scenery(), [ROBOT], SMALL, depth=False, gl="egl")
    assert red(renderer.render(balls(), AWAY).colour).any()
    assert "ray-cast, without shadows: OpenGL (egl) fails: no glGetError" in caplog.text


def test_renderer_follows_the_simulator_of_the_cell(monkeypatch):
    monkeypatch.setattr(gl, "select_gl", lambda: "")
    found = load_renderer(CELL.world, Scenery(simulator="mujoco"), lambda: [ROBOT], plain=True, camera=SMALL)
    assert isinstance(found, PhysicsRenderer) and found.needs_arm
    assert not load_renderer(CELL.world, Scenery(), lambda: [ROBOT], plain=True, camera=SMALL).needs_arm
