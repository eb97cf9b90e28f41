"""Foreign bodies: a hand is found within two images; the robot, known objects and what is held are not."""

from functools import cache

import numpy as np
import pytest

from applications.sorting.detector import HeapDetector
from applications.sorting.foreign import Debounce
from applications.sorting.topics import Foreign
from common.config import Surroundings
from common.config.loading import load_robot
from common.messages import Header, JointState, Vector3
from common.sim.ray_caster import Mesh
from common.sim.solids import robot_shapes, transformed
from tests.applications.sorting.scenes import BLUE, FLOOR, RED, box, sphere, tray_world, view_of

SECOND = 10**9  # [ns]
HAND = (0.08, 0.08, 0.10)  # [m]
SKIN = (0.9, 0.7, 0.6)
HEAP = (box(0.53, 0, (0.05, 0.05, 0.05), RED), box(0.60, 0.05, (0.06, 0.03, 0.03), BLUE, 0.4),
        sphere(0.48, -0.1, 0.03, BLUE))


@cache
def robot():
    return load_robot("panda")


def detector() -> HeapDetector:
    world = Surroundings.model_validate({name: getattr(tray_world(), name) for name in Surroundings.model_fields})
    return HeapDetector(world, robot())


def move(to: HeapDetector, q, stamp: int, width: float = 0.08) -> None:
    """Report to the detector that the arm is at q (dof,) [rad] from a time on [ns]."""
    for at in (stamp - SECOND // 100, stamp + SECOND // 100):
        to.joints.add(JointState(
            header=Header(stamp=at), name=[*robot().joints, *robot().gripper.joints],
            position=[*np.asarray(q, float).tolist(), width / 2, width / 2]))


def arm_at(to: HeapDetector, q) -> list[Mesh]:
    """Return the arm as solids."""
    poses = to.robot.link_poses(np.asarray(q, float), dict.fromkeys(robot().gripper.joints, 0.04))
    shapes = robot_shapes(to.robot)
    return [Mesh(transformed(corners, poses[link]), (0.5, 0.5, 0.5)) for link, corners in shapes.items()]


def images(to: HeapDetector, meshes, q, *, at_home: bool, count: int = 1, gripping: bool = False, start: int = 1):
    """Return the foreign bodies of each of some images of the arm at q and solids."""
    found = []
    for number in range(start, start + count):
        move(to, q, number * SECOND)
        seen = to.look([view_of([*meshes, *arm_at(to, q)], number)], number * SECOND, at_home=at_home,
                       gripping=gripping)
        assert seen is not None
        found.append(seen.heap.foreign)
    return found


def home():
    return np.array(robot().named_poses["home"])


OVER_TRAY = np.array([0.0, 0.15, 0.0, -2.0, 0.0, 2.15, 0.785])


@pytest.mark.parametrize(("at_home", "x", "y", "z"), [
    (True, 0.60, 0.10, 0.25), (False, 0.50, -0.12, 0.30), (False, 0.45, 0.30, 0.25)])
def test_hand_is_found_in_the_second_image(at_home, x, y, z):
    to = detector()
    images(to, HEAP, home(), at_home=True)
    first, second = images(to, [*HEAP, box(x, y, HAND, SKIN, z=z)], home(), at_home=at_home, count=2, start=2)
    assert first == [] and len(second) == 1
    assert (second[0].center.x, second[0].center.y) == pytest.approx((x, y), abs=0.015)
    assert second[0].center.z + second[0].size.z / 2 == pytest.approx(z + HAND[2], abs=0.01)
    assert second[0].size.x == pytest.approx(HAND[0], abs=0.02)


def test_hand_next_to_the_arm_over_the_tray_is_found():
    to = detector()
    images(to, HEAP, home(), at_home=True)
    found = images(to, [*HEAP, box(0.66, -0.13, HAND, SKIN, z=0.10)], OVER_TRAY, at_home=False, count=2, start=2)
    assert len(found[1]) == 1


@pytest.mark.parametrize("tilt", [0.0, 0.15, 0.3, 0.45])
def test_arm_and_known_heap_are_not_foreign(tilt):
    to = detector()
    images(to, HEAP, home(), at_home=True)
    q = OVER_TRAY + np.array([tilt, 0, 0, 0, 0, 0, 0])
    assert images(to, HEAP, q, at_home=False, count=3, start=2) == [[], [], []]


def test_held_object_is_not_foreign():
    to = detector()
    images(to, HEAP, home(), at_home=True)
    x, y, z = to.robot.fk(OVER_TRAY)[:3, 3]
    held = box(float(x), float(y), (0.05, 0.05, 0.06), RED, z=float(z) - 0.05)
    assert images(to, [*HEAP[1:], held], OVER_TRAY, at_home=False, count=2, gripping=True, start=2) == [[], []]


def test_object_that_was_pushed_a_little_is_not_foreign():
    to = detector()
    images(to, HEAP, home(), at_home=True)
    pushed = [box(0.55, 0.015, (0.05, 0.05, 0.05), RED), *HEAP[1:]]
    assert images(to, pushed, OVER_TRAY, at_home=False, count=2, start=2) == [[], []]


def test_hand_that_left_is_gone_at_once():
    to = detector()
    images(to, HEAP, home(), at_home=True)
    images(to, [*HEAP, box(0.6, 0.1, HAND, SKIN, z=0.25)], home(), at_home=False, count=2, start=2)
    assert images(to, HEAP, home(), at_home=False, start=4) == [[]]


def test_what_is_too_large_for_an_object_is_foreign_at_home():
    to = detector()
    move(to, home(), SECOND)
    seen = to.look([view_of([box(0.50, 0.0, (0.30, 0.08, 0.10), SKIN, z=FLOOR)])], SECOND, at_home=True, gripping=False)
    assert seen is not None and seen.heap.objects == [] and len(seen.heap.foreign) == 1


def test_image_without_a_joint_state_is_not_used():
    assert detector().look([view_of([])], SECOND, at_home=True, gripping=False) is None


def test_body_in_a_single_image_is_noise():
    bodies = [Foreign(center=Vector3(x=0.5, y=y, z=0.3), size=Vector3(x=0.08, y=0.08, z=0.1)) for y in (0.0, 0.5)]
    debounce = Debounce()
    assert [debounce.confirmed(each) for each in ([bodies[0]], [], [bodies[0]], [bodies[1]])] == [[], [], [], []]
    assert debounce.confirmed([bodies[1]]) == [bodies[1]]
