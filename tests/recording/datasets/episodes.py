"""Recordings of a few seconds for the tests of data sets: two joints, a gripper, and cameras with small images."""

from collections.abc import Collection
from pathlib import Path

import numpy as np

from common.messages import GripperState, Header, JointState, RobotDescription
from common.perception.image import array_to_image
from recording.sample import Sample
from tests.recording.samples import START, packed, write

MS = 1_000_000  # [ns]
FPS = 10
JOINTS_PERIOD, IMAGE_PERIOD = 10 * MS, 100 * MS
HEIGHT, WIDTH = 16, 24
LATE = 3 * MS  # from a stamp to its arrival


def sample(key: str, message: object, stamp: int, number: int, kind: str = "stream") -> Sample:
    return Sample(f"panda/{key}", packed(message), stamp + LATE, message=type(message).__name__, kind=kind,
                  writer=f"{key}.1", sequence=number + 1)


def position(stamp: int) -> list[float]:
    """Return positions of `a`, `finger`, `b`, from which a stamp can be read."""
    seconds = (stamp - START) * 1e-9
    return [seconds, 0.5, -2 * seconds]


def joints(number: int) -> Sample:
    stamp = START + number * JOINTS_PERIOD
    message = JointState(header=Header(stamp=stamp), name=["a", "finger", "b"], position=position(stamp))
    return sample("joint_states", message, stamp, number)


def picture(number: int) -> np.ndarray:
    """Return an RGB image whose brightness names its number, red on the left."""
    pixels = np.full((HEIGHT, WIDTH, 3), 10 * number, np.uint8)
    pixels[:, : WIDTH // 2, 0] = 250
    return pixels


def image(number: int, stamp: int, key: str = "camera/image_raw") -> Sample:
    return sample(key, array_to_image(picture(number)[..., ::-1].copy(), "bgr8", Header(stamp=stamp)), stamp, number)


def depth(number: int, stamp: int) -> Sample:
    pixels = np.full((HEIGHT, WIDTH), 1 + number / 10, np.float32)
    pixels[0, 0] = np.nan
    return sample("depth_camera/depth/image_raw", array_to_image(pixels, "32FC1", Header(stamp=stamp)), stamp, number)


def gripper(number: int, stamp: int, width: float) -> Sample:
    return sample("gripper/state", GripperState(header=Header(stamp=stamp), width=width), stamp, number, "state")


def exposure(number: int) -> int:
    """Return the stamp of an image: regular but for a jitter of 2 ms."""
    return START + 50 * MS + number * IMAGE_PERIOD + (2 * MS if number % 2 else 0)


def recording(
    path: Path, *, images: int = 12, dropped: Collection[int] = (), cameras: Collection[str] = ("camera/image_raw",),
    robot: bool = True, with_joints: bool = True, with_depth: bool = False,
) -> Path:
    """Write a run of `images` periods in which the gripper closes at 0.5 s; `dropped` images are missing."""
    samples = [joints(number) for number in range(images * IMAGE_PERIOD // JOINTS_PERIOD)] if with_joints else []
    samples += [gripper(0, START, 0.08), gripper(1, START + 500 * MS, 0.02)]
    for number in range(images):
        if number not in dropped:
            samples += [image(number, exposure(number), key) for key in cameras]
            samples += [depth(number, exposure(number))] if with_depth else []
    if robot:
        about = RobotDescription(joints=["a", "b"], lower=[-9, -9], upper=[9, 9], velocity=[1, 1], tcp="tcp")
        samples.append(sample("robot/description", about, START, 0, "state"))
    return write(path, sorted(samples, key=lambda each: each.log_time), every=30)
