"""Join joint states, gripper and camera images of one time into the observation of a policy."""

from __future__ import annotations

from bisect import bisect_right
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from applications.policy.interface import Observation, Vector
from common.messages import GripperState, Image, JointState
from common.perception.image import ImageError, image_to_array
from common.robot.model import RobotModel

JOINT_STATES, GRIPPER = "joint_states", "gripper/state"
_HISTORY = 2048  # joint states: 2 s at the highest rate of an executor
_GRIPPERS = 512  # gripper states; the executor sends them only when they change
_IMAGES = 16  # of each camera

Pixels = NDArray[np.uint8]


@dataclass(frozen=True)
class Missing:
    """Why there is no observation.

    Attributes:
        source: the camera, `joint_states` or `gripper/state`.
        message: one line for the operator.
        age: of the newest usable data of that source [s]; None if there are none.
    """

    source: str
    message: str
    age: float | None = None


@dataclass
class _Camera:
    recent: deque[Image] = field(default_factory=lambda: deque(maxlen=_IMAGES))  # by arrival: bad stamps age out
    converted: tuple[int, Pixels] | None = None  # stamp and pixels of the newest image that was used

    def drop_before(self, stamp: int) -> None:
        """Forget images that are too old, but the newest one."""
        stamp = min(stamp, max((each.header.stamp for each in self.recent), default=stamp))
        self.recent = deque((each for each in self.recent if each.header.stamp >= stamp), maxlen=_IMAGES)

    def until(self, stamp: int) -> list[Image]:
        """Return the images that are not newer than a stamp, by their stamps."""
        return sorted((each for each in self.recent if each.header.stamp <= stamp), key=lambda each: each.header.stamp)


class ObservationBuffer:
    """Recent messages of a cell, in any order of arrival; `observe` joins those of one time.

    Images are never mixed with joint positions of another time: positions and velocities are interpolated at the
    stamp of the newest image. The gripper has the newest state that is not later than that stamp.
    """

    def __init__(
        self, robot: RobotModel, cameras: Sequence[str] = (), *, image_size: tuple[int, int] | None = None,
        tolerance: float = 0.05, max_age: float = 0.5, gripper: bool = True,
    ) -> None:
        """Start without any message.

        Args:
            robot: model of the arm.
            cameras: names of the cameras, each of which every observation has.
            image_size: (width, height) [px] that images are resized to; None: as they come.
            tolerance: largest difference of the stamps of images in an observation, and largest interval between the
                two joint states around them [s, cell time].
            max_age: largest age of an observation's stamp [s, cell time].
            gripper: whether the cell has a gripper.
        """
        self._robot, self._size = robot, image_size
        self._tolerance_ns, self._max_age = int(tolerance * 1e9), max_age
        self._gripper = gripper
        self._cameras = {name: _Camera() for name in cameras}
        self._joints: deque[tuple[int, Vector, Vector | None]] = deque(maxlen=_HISTORY)
        self._grippers: deque[tuple[int, float]] = deque(maxlen=_GRIPPERS)
        self._absent_joints: list[str] = []

    def add_joints(self, message: JointState) -> None:
        """Add a joint state; one that lacks joints of the arm is not used."""
        positions = self._robot.order(message.name, message.position)
        if positions is None:
            self._absent_joints = [name for name in self._robot.joint_names if name not in message.name]
            return
        self._absent_joints = []
        velocities = self._robot.order(message.name, message.velocity) if message.velocity else None
        self._joints.append((message.header.stamp, positions, velocities))

    def add_gripper(self, message: GripperState) -> None:
        """Add a state of the gripper."""
        self._grippers.append((message.header.stamp, message.width))

    def add_image(self, camera: str, message: Image) -> None:
        """Add an image of a camera that was named at the start."""
        self._cameras[camera].recent.append(message)

    def observe(
        self, now: int, instruction: str = "", committed: NDArray[np.float64] | None = None,
    ) -> Observation | Missing:
        """Return the newest observation, or why there is none.

        Args:
            now: cell time [ns].
            instruction: what the policy is to do, in words.
            committed: joint targets (k, dof) [rad] that the arm reaches in any case, as in `Observation`.
        """
        latest = now + self._tolerance_ns  # stamps of another host may be ahead by this
        joints = sorted((each for each in self._joints if each[0] <= latest), key=lambda each: each[0])
        if not joints:
            lacks = f"joint_states lack {', '.join(self._absent_joints)}" if self._absent_joints else \
                "no joint state received yet"
            return Missing(JOINT_STATES, lacks)
        newest_joints = joints[-1][0]
        if (age := (now - newest_joints) * 1e-9) > self._max_age:
            return Missing(JOINT_STATES, f"the newest joint state is {age:.2f} s old; the limit is "
                                         f"{self._max_age:g} s", age)
        chosen = self._matching(now, newest_joints)
        if isinstance(chosen, Missing):
            return chosen
        stamp = max((image.header.stamp for image in chosen.values()), default=newest_joints)
        state = self._interpolated(joints, stamp)
        if isinstance(state, Missing):
            return state
        width = 0.0
        if self._gripper:
            if not self._grippers:
                return Missing(GRIPPER, "no gripper state received yet")
            width = self._width(stamp)
        images: dict[str, Pixels] = {}
        for name, image in chosen.items():
            try:
                images[name] = self._pixels(self._cameras[name], image)
            except ImageError as error:
                return Missing(name, f"camera {name}: {error}", (now - image.header.stamp) * 1e-9)
        positions, velocities = state
        return Observation(
            stamp, positions, velocities, self._robot.fk(positions), width, images, instruction,
            np.zeros((0, self._robot.dof)) if committed is None else committed)

    def _matching(self, now: int, newest_joints: int) -> dict[str, Image] | Missing:
        """Return the newest image of each camera such that their stamps agree; not newer than the joint states."""
        history = {}
        for name, camera in self._cameras.items():
            camera.drop_before(now - int(self._max_age * 1e9) - self._tolerance_ns)
            if not camera.recent:
                return Missing(name, f"no image of camera {name} received yet")
            history[name] = camera.until(newest_joints)
            if not history[name]:
                ahead = (min(each.header.stamp for each in camera.recent) - newest_joints) * 1e-9
                return Missing(name, f"images of camera {name} are {ahead:.2f} s ahead of the joint states", 0.0)
            age = (now - history[name][-1].header.stamp) * 1e-9
            if age > self._max_age:
                return Missing(name, f"the newest image of camera {name} is {age:.2f} s old; the limit is "
                                     f"{self._max_age:g} s", age)
        newest = {name: images[-1] for name, images in history.items()}
        while history:
            oldest, last = (choose(history, key=lambda name: history[name][-1].header.stamp) for choose in (min, max))
            stamp = history[last][-1].header.stamp
            # No set with the oldest camera has a stamp that is later than its newest one by more than the tolerance.
            if stamp - history[oldest][-1].header.stamp <= self._tolerance_ns:
                if (now - stamp) * 1e-9 > self._max_age:
                    break
                return {name: images[-1] for name, images in history.items()}
            history[last].pop()
            if not history[last]:
                break
        if not history:
            return {}
        late = min(newest, key=lambda name: newest[name].header.stamp)
        age, other = (now - newest[late].header.stamp) * 1e-9, max(newest, key=lambda name: newest[name].header.stamp)
        apart = (newest[other].header.stamp - newest[late].header.stamp) * 1e-9
        return Missing(late, f"no images of all cameras within {self._tolerance_ns * 1e-9:g} s: the newest of camera "
                             f"{late} is {age:.2f} s old, {apart:.2f} s behind camera {other}", age)

    def _interpolated(
        self, joints: list[tuple[int, Vector, Vector | None]], stamp: int,
    ) -> tuple[Vector, Vector] | Missing:
        """Return positions and velocities (dof,) at a stamp that is not later than the last of the joint states."""
        after = bisect_right(joints, stamp, key=lambda each: each[0])
        if after == 0:
            behind = (joints[0][0] - stamp) * 1e-9
            return Missing(JOINT_STATES, f"no joint state is as old as the images: the first is {behind:.2f} s later")
        t0, q0, v0 = joints[after - 1]
        if after == len(joints) or t0 == stamp:
            before = joints[after - 2] if after >= 2 else None
            if v0 is None:
                v0 = (q0 - before[1]) / ((t0 - before[0]) * 1e-9) if before and before[0] < t0 else np.zeros_like(q0)
            return q0.copy(), np.array(v0)
        t1, q1, v1 = joints[after]
        if t1 - t0 > self._tolerance_ns:
            return Missing(JOINT_STATES, f"joint states lack {(t1 - t0) * 1e-9:.2f} s around the images; the limit is "
                                         f"{self._tolerance_ns * 1e-9:g} s")
        share = (stamp - t0) / (t1 - t0)
        rate = (q1 - q0) / ((t1 - t0) * 1e-9)
        velocities = rate if v0 is None or v1 is None else v0 + share * (v1 - v0)
        return q0 + share * (q1 - q0), velocities

    def _width(self, stamp: int) -> float:
        """Return the width of the newest gripper state at a stamp; before the first one, that one's."""
        earlier = [each for each in self._grippers if each[0] <= stamp]
        return max(earlier, key=lambda each: each[0])[1] if earlier else min(self._grippers)[1]

    def _pixels(self, camera: _Camera, image: Image) -> Pixels:
        """Return an image as RGB (h, w, 3) of the configured size; the newest one is converted only once."""
        if camera.converted is None or camera.converted[0] != image.header.stamp:
            camera.converted = image.header.stamp, rgb_image(image, self._size)
        return camera.converted[1]


def rgb_image(image: Image, size: tuple[int, int] | None) -> Pixels:
    """Return an image message as RGB (h, w, 3) uint8, resized to (width, height) [px] unless that is None.

    Raises:
        ImageError: it is no color or grey image of 8 bits, or its fields are inconsistent.
    """
    if image.encoding not in ("rgb8", "bgr8", "mono8"):
        raise ImageError("encoding", f"encoding {image.encoding!r} is no color image; choices: rgb8, bgr8, mono8")
    pixels = image_to_array(image)
    if image.encoding == "bgr8":
        pixels = cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB)
    elif image.encoding == "mono8":
        pixels = cv2.cvtColor(pixels, cv2.COLOR_GRAY2RGB)
    if size is not None and pixels.shape[1::-1] != tuple(size):
        shrinks = pixels.shape[1] >= size[0] and pixels.shape[0] >= size[1]
        pixels = cv2.resize(pixels, size, interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)
    return np.asarray(pixels, np.uint8)
