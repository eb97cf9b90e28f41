import ctypes

import cv2
import numpy as np
import pytest

from common.config import CameraConfig, Scenery, load_cell
from common.config.objects import Light
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


def balls(places=PLACES):
    return [WorldObject(id=f"ball_{number}", shape="sphere", size=Vector3(x=0.06, y=0.06, z=0.06),
                        pose=Pose(position=Vector3(x=x, y=y, z=z)), color=Color(r=1.0, g=0.15, b=0.1))
            for number, (x, y, z) in enumerate(places)]


def arm(**moved):
    """At home, with joints moved by so much [rad]."""
    position = ROBOT.named("home") + [moved.get(name, 0.0) for name in ROBOT.joint_names]
    locked = ROBOT.config.locked_joints
    return JointState(header=Header(), name=[*ROBOT.joint_names, *locked], position=[*position, *locked.values()])


AWAY = arm(panda_joint1=2.8)  # turned back, out of the picture


def camera(width=640, height=480, cx=319.5, cy=239.5, **changed):
    scale = width / 640
    return Pinhole.from_config(CameraConfig(width=width, height=height, fx=520 * scale, fy=520 * scale, cx=cx, cy=cy,
                                            **changed))


SMALL = camera(160, 120, 79.5, 59.5)


def drawn(objects, joints=AWAY, *, scenery=None, view=SMALL, gl=GL, world=CELL.world):
    scenery = scenery or Scenery(lights={"above": ABOVE})
    return PhysicsRenderer(world, scenery, ROBOT, view, depth=True, gl=gl).render(objects, joints)


def red(picture):
    b, g, r = (picture[..., channel].astype(int) for channel in range(3))
    return (r > 60) & (r > 3 * g) & (r > 3 * b)


@needs_gl
def test_sphere_centers_are_rendered_at_their_projection():
    view = camera()
    _, _, boxes, centres = cv2.connectedComponentsWithStats(red(drawn(balls(), view=view).colour).astype(np.uint8))
    assert len(boxes) == 1 + len(PLACES)
    for place in PLACES:
        # The outline of a sphere off the axis is an ellipse whose middle lies beyond its centre: seen from the middle
        # of the circle in which the rays touch it.
        to_center = np.array(place) - view.position
        square = to_center @ to_center
        touch = view.position + to_center * (1 - 0.03**2 / square)
        outline = ring(touch, to_center / np.sqrt(square), 0.03 * np.sqrt(1 - 0.03**2 / square))
        area = cv2.moments(view.project(outline).astype(np.float32))
        middle = np.array((area["m10"], area["m01"])) / area["m00"]
        nearest = centres[1:][np.argmin(np.linalg.norm(centres[1:] - middle, axis=1))]
        np.testing.assert_allclose(nearest, middle, atol=0.15)
        assert np.linalg.norm(nearest - view.project(place)) < 0.8


def ring(centre, axis, radius):
    across = np.linalg.svd(axis[None])[2][1:]
    angles = np.linspace(0, 2 * np.pi, 720, endpoint=False)
    return centre + radius * (np.cos(angles)[:, None] * across[0] + np.sin(angles)[:, None] * across[1])


@needs_gl
def test_principal_point_shifts_the_image():
    here, there = drawn(balls()).colour, drawn(balls(), view=camera(160, 120, 89.5, 52.5)).colour
    np.testing.assert_array_equal(red(here)[20:100, 20:140], red(there)[13:93, 30:150])


@pytest.mark.parametrize("gl", [pytest.param(GL, marks=needs_gl), ""])
def test_non_square_pixels_and_off_center_axis_are_supported(gl):
    view = Pinhole.from_config(CameraConfig(width=160, height=120, fx=150, fy=110, cx=70, cy=66))
    _, _, _, middles = cv2.connectedComponentsWithStats(red(drawn(balls(), view=view, gl=gl).colour).astype(np.uint8))
    for place in view.project(PLACES):
        assert np.linalg.norm(middles[1:] - place, axis=1).min() < 0.6


@pytest.mark.parametrize("gl", [pytest.param(GL, marks=needs_gl), ""])
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
    whole = cv2.dilate(other.depth, square) - cv2.erode(other.depth, square) < 0.01  # nothing ends there
    assert whole.mean() > 0.7
    apart = np.abs(one.depth - other.depth)[whole]
    assert np.mean(apart > 1e-3) < 0.01
    different = np.abs(one.colour.astype(int) - other.colour).max(axis=2)[whole]
    assert np.mean(different > 40) < 0.05, "rays see no highlights, and faces instead of what is round"


@pytest.mark.parametrize("gl", [pytest.param(GL, marks=needs_gl), ""])
def test_arm_is_rendered_at_its_joint_positions(gl):
    home, away = drawn([], arm(), gl=gl), drawn([], AWAY, gl=gl)
    hidden = home.depth < 0.5
    assert 0.05 < hidden.mean() < 0.6 and not (away.depth < 0.5).any()
    moved = drawn([], arm(panda_joint1=0.2), gl=gl)
    assert (moved.depth < 0.5).any() and (hidden != (moved.depth < 0.5)).any()


@needs_gl
def test_objects_cast_shadows_away_from_the_light():
    shadow = drawn(balls([(0.3, -0.2, 0.03)]), scenery=Scenery(lights={"aside": ASIDE})).colour
    none = drawn(balls([(0.3, -0.2, 0.03)]), scenery=Scenery(
        lights={"aside": ASIDE.model_copy(update={"shadow": False})})).colour
    dark = shadow.astype(int).sum(axis=2) < 0.7 * none.astype(int).sum(axis=2)
    where = SMALL.on_plane(np.argwhere(dark & ~red(none))[:, ::-1], 0.0)
    where = where[np.linalg.norm(where - (0.3, -0.2), axis=1) < 0.12]  # arm and container have shadows of their own
    assert len(where) > 10
    x, y = where.mean(axis=0)
    assert y < -0.22 and abs(x - 0.3) < 0.01, "the light comes from +y"


@needs_gl
def test_dimmed_and_warm_light_change_level_and_colors():
    bright, dim, warm = (
        PhysicsRenderer(CELL.world, Scenery(lights={"above": light}, ambient=0.2 * light.illuminance), ROBOT, SMALL,
                        depth=False, gl=GL)
        for light in (ABOVE, ABOVE.model_copy(update={"illuminance": 35.0}),
                      ABOVE.model_copy(update={"temperature": 2700.0})))
    np.testing.assert_allclose(dim.level, bright.level / 10)
    assert warm.level[2] > bright.level[2] and warm.level[0] < 0.5 * bright.level[0]
    one, other = bright.render(balls(), AWAY).colour, dim.render(balls(), AWAY).colour
    np.testing.assert_allclose(one, other, atol=2)


@needs_gl
def test_one_lamp_can_be_dimmed():
    lamps = {"left": Light(position=(0.4, 0.6, 1.0), aim=(0.4, 0.2, 0.0), parallel=False, shadow=False),
             "right": Light(position=(0.4, -0.6, 1.0), aim=(0.4, -0.2, 0.0), parallel=False, shadow=False)}
    renderer = PhysicsRenderer(CELL.world, Scenery(lights=lamps), ROBOT, SMALL, depth=False, gl=GL)
    both = renderer.render([], AWAY).colour * renderer.level
    lamps = lamps | {"right": lamps["right"].model_copy(update={"illuminance": 20.0})}
    renderer.set_light(Scenery(lights=lamps))
    one = renderer.render([], AWAY).colour * renderer.level
    left, right = slice(20, 40), slice(120, 140)  # +y is left in the picture
    assert one[:, right].mean() < 0.6 * both[:, right].mean() < one[:, left].mean()


@pytest.mark.parametrize("gl", [pytest.param(GL, marks=needs_gl), ""])
def test_lamp_lights_only_its_cone(gl):
    low = Light(position=(0.4, 0.0, 0.25), aim=(0.4, 0.0, 0.0), parallel=False)
    picture = drawn([], gl=gl, scenery=Scenery(lights={"low": low}, ambient=50)).colour[..., 1]
    inside, outside = ((round(float(v)), round(float(u))) for u, v in SMALL.project(np.array([
        (0.4, -0.1, 0.0), (0.4, -0.35, 0.0)])))
    assert 0 < picture[outside] < 0.2 * picture[inside], "of light from everywhere alone"


def test_elsewhere_is_not_rendered_and_unchanged_scenes_are_cached():
    renderer = PhysicsRenderer(CELL.world, Scenery(), ROBOT, SMALL, depth=False, gl="")
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
    renderer = PhysicsRenderer(CELL.world, Scenery(), ROBOT, SMALL, depth=False, gl="egl")
    assert red(renderer.render(balls(), AWAY).colour).any()
    assert "ray-cast, without shadows: OpenGL (egl) fails: no glGetError" in caplog.text


def test_renderer_follows_the_simulator_of_the_cell(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "off")
    select_gl.cache_clear()
    try:
        found = load_renderer(CELL.world, Scenery(simulator="mujoco"), lambda: ROBOT, plain=True, camera=SMALL)
    finally:
        select_gl.cache_clear()
    assert isinstance(found, PhysicsRenderer) and found.needs_arm
    drawn_flat = load_renderer(CELL.world, Scenery(), lambda: ROBOT, plain=True, camera=SMALL)
    assert not drawn_flat.needs_arm
