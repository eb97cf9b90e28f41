"""The tries of a run for its report: the picture before and after, grasp, width, score and result of each."""

from __future__ import annotations

import base64
import html
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.fingers import finger_lines
from applications.sorting.topics import HEAP, SORTING_STATUS, GraspCandidate, Heap, SortingStatus
from common import messages as m
from common import topics
from common.perception.camera_input import FrameError, decode_color_image
from common.perception.pinhole import CameraError, Pinhole
from common.robot.transforms import pose_to_matrix
from recording.report.application import Listener, Section

if TYPE_CHECKING:
    from common.topics import Topic

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]

MOST = 60  # tries in a report
IMAGES = 40  # newest images among which that of a heap is found
SIDE = 220  # [px] of a picture
NEAREST = 0.1  # [m] a grasp nearer to the camera is not shown
AROUND = 0.13  # [m] from the grasp to the borders of its picture
LINE = (60, 220, 90)  # blue, green, red
QUALITY = 70  # of WebP, 1 to 100


@dataclass
class Try:
    """One closing of the fingers."""

    at: float  # [s] since the start of the recording
    number: int
    subject: str
    grasp: GraspCandidate | None
    before: str  # data URL, empty without a picture
    after: str = ""
    width: float | None = None  # between the fingers when they had closed [m]
    held: str = ""
    result: str = ""


class Tries:
    """Collects the tries of a run from its messages.

    Pictures are those by which the task decided, and the first one from home afterwards.
    """

    def __init__(self, closing_axis: int = 1) -> None:
        """Start without messages.

        Args:
            closing_axis: of the tool, 0 or 1, along which the fingers close.
        """
        self.tries: list[Try] = []
        self.left_out = 0
        self._axis = closing_axis
        self._images: deque[m.Image] = deque(maxlen=IMAGES)
        self._heap: Heap | None = None  # from home
        self._before: m.Image | None = None  # its image
        self._info: m.CameraInfo | None = None
        self._frames: dict[str, Array] = {}  # (4, 4) in world, of frames that are fixed there
        self._width = 0.0
        self._attempts = 0

    def listeners(self) -> dict[Topic[Any], Listener]:
        """Return listeners of what a report shows."""
        return {
            SORTING_STATUS: self.on_status, HEAP: lambda _, heap: self.on_heap(heap),
            topics.DEPTH_CAMERA_IMAGE: lambda _, image: self._images.append(image),
            topics.DEPTH_CAMERA_INFO: lambda _, info: setattr(self, "_info", info),
            topics.TF_STATIC: lambda _, transforms: self.on_transforms(transforms),
            topics.GRIPPER_STATE: lambda _, state: self.on_gripper(state),
        }

    def on_transforms(self, message: m.TFMessage) -> None:
        """Take the poses of frames that are fixed in world."""
        for each in message.transforms:
            if each.header.frame_id == "world":
                self._frames[each.child_frame_id] = pose_to_matrix(each.transform)

    def on_gripper(self, state: m.GripperState) -> None:
        """Take the width of the fingers."""
        self._width = state.width
        if self.tries and state.holding and self.tries[-1].width is None:
            self.tries[-1].width = state.width

    def on_heap(self, heap: Heap) -> None:
        """Take what the cameras see from home; it ends the newest try."""
        if not heap.at_home:
            return
        self._heap = heap
        self._before = next((each for each in reversed(self._images) if each.header.stamp == heap.header.stamp), None)
        last = self.tries[-1] if self.tries else None
        if last is not None and last.result and not last.after:
            last.after = self._picture(self._before, last.grasp, drawn=False)

    def on_status(self, time: float, status: SortingStatus) -> None:
        """Start a try when the task counts one; its result follows."""
        if status.attempts > self._attempts:
            self._attempts = status.attempts
            if len(self.tries) < MOST:
                grasp = self._grasp_of(status)
                self.tries.append(Try(time, status.attempts, status.subject, grasp,
                                      self._picture(self._before, grasp, drawn=True)))
            else:
                self.left_out += 1
        if self.tries and self.tries[-1].number == status.attempts:
            last = self.tries[-1]
            last.held, last.result = status.held or last.held, status.last or last.result
            if last.width is None and last.result:
                last.width = self._width

    def _grasp_of(self, status: SortingStatus) -> GraspCandidate | None:
        """Return the grasp that is tried: by its id, else the best one of the object."""
        grasps = self._heap.grasps if self._heap is not None else []
        return next((each for each in grasps if each.id == status.grasp), None) or next(
            (each for each in grasps if each.object == status.subject), None)

    def _picture(self, image: m.Image | None, grasp: GraspCandidate | None, *, drawn: bool) -> str:
        """Return the surroundings of a grasp in an image as a data URL; empty without image or camera."""
        if image is None or grasp is None or self._info is None:
            return ""
        pose = self._frames.get(self._info.header.frame_id)
        try:
            pixels = decode_color_image(image).copy()
            camera = Pinhole.from_info(self._info, np.eye(4) if pose is None else pose)
        except (FrameError, CameraError):
            return ""
        if pose is None:  # a camera on the arm: its pose is not known here
            return _encoded(cv2.resize(pixels, (SIDE, SIDE)))
        at, lines = pose_to_matrix(grasp.pose)[:3, 3], camera.project(finger_lines(grasp, self._axis))
        (u, v), distance = camera.project(at), float(camera.to_camera(at)[2])
        if not (camera.in_image((u, v)) and np.isfinite(lines).all() and distance > NEAREST):
            return ""
        if drawn:
            for a, b in lines.round().astype(int):
                cv2.line(pixels, a.tolist(), b.tolist(), LINE, 2, cv2.LINE_AA)
        size = round(2 * AROUND * camera.fx / distance)
        cut = cv2.getRectSubPix(pixels, (size, size), (float(u), float(v)))
        return _encoded(cv2.resize(cut, (SIDE, SIDE), interpolation=cv2.INTER_AREA))

    def section(self) -> Section | None:
        """Return a table of the tries with their pictures; None without a try."""
        if not self.tries:
            return None
        rows = "".join(_row(each) for each in self.tries)
        more = f"<p>{self.left_out} later tries are left out.</p>" if self.left_out else ""
        return Section("tries", "Tries", (
            "<table><tr><th>#</th><th>time [s]</th><th>object</th><th>before</th><th>after</th><th>width [mm]</th>"
            f"<th>score</th><th>held</th><th>result</th></tr>{rows}</table>{more}"
            "<p>Green: the fingers at the grasp, open as on the way. Width: the distance of the contacts as it was "
            "seen, and the one between the fingers when they had closed.</p>"))


def _encoded(pixels: Pixels | npt.NDArray[Any]) -> str:
    _, data = cv2.imencode(".webp", pixels, [cv2.IMWRITE_WEBP_QUALITY, QUALITY])
    return f"data:image/webp;base64,{base64.b64encode(data.tobytes()).decode()}"


def _row(each: Try) -> str:
    def image(address: str, name: str) -> str:
        return f'<img src="{address}" width="{SIDE}" height="{SIDE}" alt="{name}">' if address else "no picture"

    seen = "" if each.grasp is None else f"{1e3 * each.grasp.width:.0f}"
    closed = "–" if each.width is None else f"{1e3 * each.width:.0f}"
    score = "" if each.grasp is None else f"{each.grasp.score:.2f}"
    cells = [str(each.number), f"{each.at:.1f}", html.escape(each.subject), image(each.before, "before"),
             image(each.after, "after"), f"{seen} / {closed}", score, html.escape(each.held), html.escape(each.result)]
    return "<tr>" + "".join(f"<td>{cell}</td>" for cell in cells) + "</tr>"
