"""An observation has images and joint positions of one time, or there is none and the reason is stated."""

import itertools
import random
import weakref

import numpy as np
import pytest

from applications.policy.interface import Observation
from applications.policy.observation import Missing, ObservationBuffer
from common.messages import GripperState, Header, JointState
from common.perception.image import array_to_image
from tests.applications.policy.panda import READY, panda

MS = 1_000_000
START = 1_000_000 * MS
RATE = np.array([0.1, 0.2, 0.0, 0.0, -0.3, 0.0, 0.0])  # [rad/s]


def joints(ms, names=None, velocity=True):
    positions = READY + RATE * ms * 1e-3
    return JointState(header=Header(stamp=START + ms * MS), name=names or panda().joint_names,
                      position=positions.tolist(), velocity=RATE.tolist() if velocity else [])


def image(ms, value=0, encoding="rgb8", shape=(48, 64, 3)):
    dtype = np.uint16 if encoding == "16UC1" else np.uint8
    return array_to_image(np.full(shape, value, dtype), encoding, Header(stamp=START + ms * MS))


def gripper(ms, width):
    return GripperState(header=Header(stamp=START + ms * MS), width=width)


def buffer(*cameras, **options):
    return ObservationBuffer(panda(), cameras, **{"image_size": (32, 24), **options})


def filled(*cameras, until=200, skip=(), **options):
    made = buffer(*cameras, **options)
    made.add_gripper(gripper(0, 0.08))
    for ms in range(0, until + 1, 10):
        if ms not in skip:
            made.add_joints(joints(ms))
    return made


def observe(made, ms=200, **options):
    return made.observe(START + ms * MS, **options)


def test_joints_are_interpolated_at_the_stamp_of_the_image():
    made = filled("top")
    made.add_image("top", image(123, 7))
    seen = observe(made, instruction="pick", committed=np.ones((2, 7)))
    assert isinstance(seen, Observation) and seen.stamp == START + 123 * MS
    np.testing.assert_allclose(seen.positions, READY + RATE * 0.123, atol=1e-9)
    np.testing.assert_allclose(seen.velocities, RATE)
    np.testing.assert_allclose(seen.tcp, panda().fk(seen.positions))
    assert seen.images["top"].shape == (24, 32, 3) and (seen.images["top"] == 7).all()
    assert seen.instruction == "pick" and seen.committed.shape == (2, 7)


def test_velocities_come_from_positions_if_joint_states_have_none():
    made = buffer("top", gripper=False)
    for ms in range(0, 201, 10):
        made.add_joints(joints(ms, velocity=False))
    made.add_image("top", image(123))
    np.testing.assert_allclose(observe(made).velocities, RATE, atol=1e-6)


def test_without_cameras_the_newest_joint_state_is_observed():
    seen = observe(filled())
    assert seen.stamp == START + 200 * MS and not seen.images
    np.testing.assert_allclose(seen.positions, READY + RATE * 0.2)


def test_order_of_arrival_does_not_matter():
    messages = [("joints", joints(ms)) for ms in range(0, 201, 10)]
    messages += [("top", image(ms, ms)) for ms in range(0, 200, 33)]
    messages += [("wrist", image(ms + 4, ms)) for ms in range(0, 200, 33)]
    seen = []
    for seed in range(5):
        random.Random(seed).shuffle(messages)
        made = buffer("top", "wrist")
        made.add_gripper(gripper(0, 0.08))
        for name, message in messages:
            if name == "joints":
                made.add_joints(message)
            else:
                made.add_image(name, message)
        seen.append(observe(made))
    for each in seen:  # the wrist image of 202 ms is ahead of the joint states
        assert each.stamp == START + 198 * MS
        assert each.images["top"][0, 0, 0] == 198 and each.images["wrist"][0, 0, 0] == 165


def test_the_newest_set_within_the_tolerance_is_used_although_one_camera_dropped_an_image():
    made = filled("top", "wrist", tolerance=0.02)
    for ms in (60, 100, 140, 180):
        made.add_image("top", image(ms, ms))
    for ms in (65, 105, 150):  # 185 was dropped
        made.add_image("wrist", image(ms, ms))
    seen = observe(made)
    assert seen.stamp == START + 150 * MS
    assert seen.images["top"][0, 0, 0] == 140 and seen.images["wrist"][0, 0, 0] == 150


def test_the_set_is_the_newest_of_all_sets_within_the_tolerance():
    rng = random.Random(2)
    for _ in range(60):
        stamps = {name: rng.sample(range(600, 1000), rng.randint(1, 5)) for name in ("a", "b", "c")}
        made = filled(*stamps, until=1000, tolerance=0.04)
        for name, all_of_one in stamps.items():
            for ms in all_of_one:
                made.add_image(name, image(ms, shape=(2, 2, 3)))
        agreeing = [each for each in itertools.product(*stamps.values()) if max(each) - min(each) <= 40]
        seen = observe(made, 1000)
        if agreeing:
            assert seen.stamp == START + max(map(max, agreeing)) * MS
        else:
            assert isinstance(seen, Missing) and "no images of all cameras within 0.04 s" in seen.message


def test_image_ahead_of_the_joint_states_waits_for_them():
    made = filled("top", until=150)
    made.add_image("top", image(120, 1))
    made.add_image("top", image(160, 2))
    assert observe(made, 165).stamp == START + 120 * MS
    made.add_joints(joints(160))
    assert observe(made, 165).stamp == START + 160 * MS


def test_image_with_a_stamp_in_the_future_does_not_block_later_ones():
    made = filled("top")
    made.add_image("top", image(3_600_000))
    made.add_image("top", image(150))
    assert observe(made).stamp == START + 150 * MS


def test_old_images_are_not_held():
    made = filled("top", until=900)
    images = [image(ms) for ms in range(0, 900, 100)]
    for each in images:
        made.add_image("top", each)
    references = [weakref.ref(each) for each in images]
    assert observe(made, 900).stamp == START + 800 * MS
    del images, each
    assert [number for number, reference in enumerate(references) if reference()] == [4, 5, 6, 7, 8]
    assert observe(made, 5000).age == pytest.approx(4.1)


def test_gripper_is_the_newest_not_later_than_the_image():
    made = filled("top")
    for ms, width in ((180, 0.01), (100, 0.05), (140, 0.03)):
        made.add_gripper(gripper(ms, width))
    made.add_image("top", image(150))
    assert observe(made).gripper == 0.03


@pytest.mark.parametrize("encoding,shape,pixel", [
    ("bgr8", (48, 64, 3), [30, 20, 10]), ("rgb8", (48, 64, 3), [10, 20, 30]), ("mono8", (48, 64), [9, 9, 9])])
def test_images_are_rgb(encoding, shape, pixel):
    made = filled("top", image_size=None)
    colors = [10, 20, 30] if len(shape) == 3 else 9
    pixels = np.broadcast_to(np.array(colors, np.uint8), shape)
    made.add_image("top", array_to_image(pixels, encoding, Header(stamp=START + 150 * MS)))
    seen = observe(made).images["top"]
    assert seen.shape == (48, 64, 3) and seen[5, 5].tolist() == pixel


def put(*images):
    def add(made):
        for name, ms in images:
            made.add_image(name, image(ms))
    return add


def bad_image(made):
    made.add_image("top", image(150, encoding="16UC1", shape=(48, 64)))


def truncated(made):
    made.add_image("top", image(150).model_copy(update={"data": b"123"}))


MISSING = [  # name, cameras, joints until [ms], missing joints, what is added, source, text, age [s]
    ("no image", ["top"], 200, (), put(), "top", "no image of camera top", None),
    ("late image", ["top"], 1200, (), put(("top", 100)), "top", "camera top is 1.10 s old; the limit is 0.5 s", 1.1),
    ("a camera stopped", ["top", "wrist"], 1200, (), put(("top", 1190), ("wrist", 300)), "wrist",
     "camera wrist is 0.90 s old", 0.9),
    ("cameras disagree", ["top", "wrist"], 1200, (), put(("top", 1190), ("wrist", 1000)), "wrist",
     "within 0.05 s: the newest of camera wrist is 0.20 s old, 0.19 s behind camera top", 0.2),
    ("joints stopped", ["top"], 400, (), put(("top", 1190)), "joint_states", "joint state is 0.80 s old", 0.8),
    ("joint states dropped", ["top"], 1200, range(1100, 1180, 10), put(("top", 1150)), "joint_states",
     "lack 0.09 s around the images", None),
    ("image before all joints", ["top"], 1200, range(0, 1100, 10), put(("top", 1050)), "joint_states",
     "no joint state is as old", None),
    ("only future images", ["top"], 1200, (), put(("top", 9000)), "top", "7.80 s ahead of the joint states", 0.0),
    ("depth image", ["top"], 200, (), bad_image, "top", "'16UC1' is no color image", 0.05),
    ("truncated image", ["top"], 200, (), truncated, "top", "3 bytes are too few", 0.05),
]


@pytest.mark.parametrize("cameras,until,skip,add,source,text,age", [row[1:] for row in MISSING],
                         ids=[row[0] for row in MISSING])
def test_without_data_of_one_time_the_reason_is_stated(cameras, until, skip, add, source, text, age):
    made = filled(*cameras, until=until, skip=skip)
    add(made)
    seen = observe(made, max(200, 1200 if until > 200 else 200))
    assert isinstance(seen, Missing) and seen.source == source
    assert text in seen.message and "\n" not in seen.message
    assert seen.age == (None if age is None else pytest.approx(age))


def test_missing_joints_and_gripper_are_named():
    made = buffer()
    assert "no joint state" in observe(made).message
    made.add_joints(joints(200, [*panda().joint_names[:6], "other"]))
    assert panda().joint_names[6] in observe(made).message
    made.add_joints(joints(200))
    seen = observe(made)
    assert (seen.source, seen.message) == ("gripper/state", "no gripper state received yet")
    assert isinstance(observe(buffer(gripper=False)), Missing)
