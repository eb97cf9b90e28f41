"""Arrays of actions, as policies return them, and chunks."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from applications.policy.decoding import MAX_ROWS, columns
from applications.policy.interface import Chunk, Observation, PolicyFailed
from applications.policy.sources.settings import ActionFormat, PolicyCell

Array = NDArray[np.float64]


def chunk_of(actions: object, observation: Observation, form: ActionFormat, cell: PolicyCell) -> Chunk:
    """Return the chunk of an array (n, columns), whose further column, if it has one, is the gripper.

    Raises:
        PolicyFailed: it is no array of numbers of such a shape, with what was expected and what came.
    """
    dof = len(observation.positions)
    count = columns(form.kind, dof)
    array = numbers(actions, f"(n, {count}) or, with the gripper, (n, {count + 1})")
    if array.ndim != 2 or array.shape[1] not in (count, count + 1) or not 1 <= len(array) <= MAX_ROWS:
        raise PolicyFailed(f"actions of kind {form.kind} must be of shape (n, {count}) or, with the gripper, (n, "
                           f"{count + 1}), n at most {MAX_ROWS}; they are {_shape(array)}")
    values = array[:, :count].astype(float)
    if form.scale:
        if len(form.scale) not in (1, count):
            raise PolicyFailed(f"actions.scale has {len(form.scale)} values; {form.kind} needs 1 or {count}")
        with np.errstate(all="ignore"):
            values = values * np.array(form.scale)
    if form.cumulative:
        values = summed(values, form.kind)
    gripper = widths_of(array[:, count].astype(float), form, cell) if array.shape[1] > count else None
    return Chunk(observation.stamp, form.rate, form.kind, values, gripper)


def numbers(given: object, expected: str) -> Array:
    """Return an array of numbers.

    Raises:
        PolicyFailed: it is none, with what was expected.
    """
    try:
        array = np.asarray(given)
    except Exception as error:  # of another library's array
        raise PolicyFailed(f"actions must be an array {expected}: {one_line(error)}") from None
    if array.dtype.kind not in "fiu" or array.dtype.itemsize > 8:
        found = type(given).__name__ if array.dtype.kind == "O" else f"an array of {array.dtype}"
        raise PolicyFailed(f"actions must be an array {expected} of numbers, not {found[:80]}")
    return array


def summed(values: Array, kind: str) -> Array:
    """Return steps (n, columns) from the observation of steps from row to row; rotations are composed."""
    with np.errstate(all="ignore"):
        total = np.cumsum(values, axis=0)
    if kind == "tcp_steps" and np.isfinite(values).all():
        turned = np.eye(3)
        for row, step in enumerate(values[:, 3:]):
            turned = np.asarray(cv2.Rodrigues(step)[0]) @ turned
            total[row, 3:] = cv2.Rodrigues(turned)[0].ravel()
    return total


def widths_of(column: Array, form: ActionFormat, cell: PolicyCell) -> Array:
    """Return widths (n,) [m] of the gripper's column, within 0 and the open width where it is no width itself."""
    if form.gripper_open is None:
        return column
    with np.errstate(all="ignore"):
        share = (column - form.gripper_closed) / (form.gripper_open - form.gripper_closed)
    return np.clip(share, 0.0, 1.0) * cell.gripper_width


def gripper_value(width: float, form: ActionFormat, cell: PolicyCell) -> float:
    """Return what the gripper's column has at a width [m]."""
    if form.gripper_open is None or not cell.gripper_width:
        return width
    return form.gripper_closed + (form.gripper_open - form.gripper_closed) * width / cell.gripper_width


def one_line(error: BaseException) -> str:
    """Return an error and its type in one line of at most 200 characters."""
    try:
        text = " ".join(f"{type(error).__name__}: {error}".split())
    except Exception:  # of the error's own __str__
        text = type(error).__name__
    return text if len(text) <= 200 else text[:197] + "..."


def _shape(array: Array) -> str:
    return "x".join(map(str, array.shape)) if array.ndim <= 8 else f"of {array.ndim} dimensions"
