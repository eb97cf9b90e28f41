"""Draw what was seen into the camera image: outlines, ids, the best grasps, and reasons for objects without one."""

from __future__ import annotations

import cv2
import numpy as np
import numpy.typing as npt

from applications.sorting.topics import Foreign, GraspCandidate, Heap, SeenObject
from common.perception.labels import WIDTH, draw_labels
from common.perception.pinhole import Pinhole
from common.robot.transforms import pose_to_matrix

Array = npt.NDArray[np.float64]
Pixels = npt.NDArray[np.uint8]
Bgr = tuple[int, int, int]

OUTLINE: Bgr = (255, 255, 255)
BEST: Bgr = (80, 220, 80)
PROVED: Bgr = (60, 170, 60)
UNPROVED: Bgr = (60, 140, 255)
FOREIGN: Bgr = (200, 40, 255)
BEHIND: Bgr = (32, 32, 32)  # text
MOST_GRASPS = 12  # drawn
MOST_LINES = 6  # of reasons
TEXT = 0.38  # scale of their font
FINGER = 0.011  # [m] half width of a finger bar
_SHIFT = 4  # fractional bits of pixels


def annotate_heap(image: Pixels, camera: Pinhole, heap: Heap, closing: Array | None = None) -> Pixels:
    """Return a copy of the bgr8 image with objects, grasps and foreign bodies.

    Args:
        image: (height, width, 3), not modified.
        camera: that took it.
        heap: what it shows.
        closing: (3,) axis along which fingers close, in the frame of the tool; default: y.
    """
    shown = image.copy()
    labels: list[tuple[str, float, float, float]] = []
    best = {grasp.object: grasp.score for grasp in reversed(heap.grasps) if grasp.proved}
    for seen in heap.objects:
        pixels = _draw_outline(shown, camera, seen)
        if pixels is not None:
            text = f"{seen.id} {best[seen.id]:.2f}" if seen.id in best else seen.id
            labels.append((text, *pixels.mean(axis=0).tolist(), float(np.ptp(pixels[:, 1])) / 2))
    axis = np.array([0.0, 1.0, 0.0]) if closing is None else np.asarray(closing, float)
    for index in range(min(len(heap.grasps), MOST_GRASPS) - 1, -1, -1):  # the best is drawn last
        _draw_fingers(shown, camera, heap.grasps[index], axis, first=index == 0)
    for body in heap.foreign:
        pixels = _draw_box(shown, camera, body)
        if pixels is not None:
            labels.append(("foreign", *pixels.mean(axis=0).tolist(), float(np.ptp(pixels[:, 1])) / 2))
    draw_labels(shown, labels)
    _list_reasons(shown, heap)
    return shown


def _draw_outline(image: Pixels, camera: Pinhole, seen: SeenObject) -> Array | None:
    """Draw the outline at the height of the top; return its pixels (n, 2), or None if it is not visible."""
    if len(seen.outline) < 2:
        return None
    corners = np.array([(x, y, seen.top) for x, y in seen.outline])
    pixels = camera.project(corners)
    if not np.isfinite(pixels).all():
        return None
    cv2.polylines(image, [_fixed(pixels)], True, OUTLINE, 1, cv2.LINE_AA, _SHIFT)
    return pixels


def _list_reasons(image: Pixels, heap: Heap) -> None:
    """Write at the top left why objects have no grasp; objects with the same reason share a line."""
    by_reason: dict[str, list[str]] = {}
    for each in heap.left:
        by_reason.setdefault(each.reason, []).append(each.object)
    lines = [f"{', '.join(names)}: {reason}" for reason, names in by_reason.items()][:MOST_LINES]
    factor = max(1.0, image.shape[1] / WIDTH)
    for number, line in enumerate(lines, 1):
        left, bottom = round(6 * factor), round(15 * factor * number)
        (width, height), base = cv2.getTextSize(line, cv2.FONT_HERSHEY_SIMPLEX, TEXT * factor, 1)
        cv2.rectangle(image, (left - 2, bottom - height - 2), (left + width + 2, bottom + base), BEHIND, cv2.FILLED)
        cv2.putText(image, line, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, TEXT * factor, OUTLINE, 1, cv2.LINE_AA)


def _draw_fingers(image: Pixels, camera: Pinhole, grasp: GraspCandidate, axis: Array, *, first: bool) -> None:
    """Draw a grasp as two bars, at the opening, and a line between the contacts."""
    color = (BEST if first else PROVED) if grasp.proved else UNPROVED
    T = pose_to_matrix(grasp.pose)
    along, across = T[:3, :3] @ axis, T[:3, :3] @ np.cross(axis, (0.0, 0.0, 1.0))
    center = T[:3, 3]
    contacts = camera.project(np.array([center + side * grasp.width / 2 * along for side in (-1, 1)]))
    bars = [camera.project(np.array([
        center + side * grasp.opening / 2 * along + end * FINGER * across for end in (-1, 1)])) for side in (-1, 1)]
    if not all(np.isfinite(each).all() for each in (contacts, *bars)):
        return
    cv2.polylines(image, [_fixed(contacts)], False, color, 1, cv2.LINE_AA, _SHIFT)
    cv2.polylines(image, [_fixed(bar) for bar in bars], False, color, 3 if first else 2, cv2.LINE_AA, _SHIFT)


def _draw_box(image: Pixels, camera: Pinhole, body: Foreign) -> Array | None:
    """Draw the silhouette of a box; return its pixels, or None if it is not visible."""
    center = np.array([body.center.x, body.center.y, body.center.z])
    half = np.array([body.size.x, body.size.y, body.size.z]) / 2
    corners = center + half * np.array([(x, y, z) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    pixels = camera.project(corners)
    if not np.isfinite(pixels).all():
        return None
    hull = cv2.convexHull(pixels.astype(np.float32)).reshape(-1, 2).astype(float)
    cv2.polylines(image, [_fixed(hull)], True, FOREIGN, 2, cv2.LINE_AA, _SHIFT)
    return hull


def _fixed(pixels: Array) -> npt.NDArray[np.int32]:
    """Fixed-point coordinates for OpenCV, clipped far outside the image."""
    return np.rint(np.clip(pixels, -4000, 20000) * (1 << _SHIFT)).astype(np.int32)
