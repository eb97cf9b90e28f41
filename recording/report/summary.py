"""Summary of a run: figures that every cell has; the file that `zencell run --summary` writes."""

from __future__ import annotations

import json
import math
from array import array
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from common.messages import (
    MotionStatus,
    PlanFigure,
    Rejection,
    Rejections,
    TaskStatus,
    Vector3,
)
from common.messages.camera import INSIDE_CONTAINER, PARTLY_OUT_OF_VIEW
from recording.report.application import Figures
from recording.report.history import Truth

SAME_PLACE = 0.03  # [m] rejections closer than this are of the same object
MOST_PLACES = 1000  # newest rejected positions that are listed
MOST_PLANS = 10_000  # newest plans, over restarts of the task
MAX_LATENCIES = 20_000  # of frames; then the older half is dropped: at 10 Hz the last quarter of an hour stays


@dataclass
class Rejected:
    """Positions at which the task rejected an object, with the newest reason for each."""

    places: list[Rejection] = field(default_factory=list)

    def add(self, rejections: Iterable[Rejection]) -> None:
        """Add rejected objects; a newer one replaces an older one at the same position [m]."""
        at = [_place(known.position) for known in self.places]
        for rejection in rejections:
            if INSIDE_CONTAINER in rejection.reason:
                continue
            place = _place(rejection.position)
            for index, known in enumerate(at):
                if abs(known[0] - place[0]) < SAME_PLACE and math.dist(known, place) < SAME_PLACE:
                    self.places[index], at[index] = rejection, place
                    break
            else:
                self.places.append(rejection)
                at.append(place)
                del self.places[:-MOST_PLACES], at[:-MOST_PLACES]


@dataclass
class Counted:
    """Figures of the task that start at zero when its process restarts."""

    failures: int = 0
    retries: int = 0
    moving: float = 0.0  # cell time [s]
    planning: float = 0.0  # wall time [s]
    plans: list[PlanFigure] = field(default_factory=list)

    @classmethod
    def of(cls, status: TaskStatus) -> Counted:
        """Return the figures of a status."""
        return cls(status.failures, status.retries, status.moving_seconds, status.planning_seconds, list(status.plans))

    def __add__(self, other: Counted) -> Counted:
        """Return the sum over two lives of the process."""
        return Counted(
            self.failures + other.failures,
            self.retries + other.retries,
            self.moving + other.moving,
            self.planning + other.planning,
            [*self.plans, *other.plans][-MOST_PLANS:],
        )

    def restarted_since(self, earlier: Counted) -> bool:
        """Return whether the process must have restarted since the earlier figures."""
        return (
            self.failures < earlier.failures
            or self.retries < earlier.retries
            or self.moving < earlier.moving - 1e-9
            or self.planning < earlier.planning - 1e-9
            or len(self.plans) < len(earlier.plans)
        )


class Summary:
    """Figures of one run."""

    def __init__(
        self, cell: str, seed: int, speed: float, figures: Figures | None = None, containers: Sequence[str] = (),
        *, fills: bool = False,
    ) -> None:
        """Start without messages.

        Args:
            cell: name of the cell.
            seed: of the run.
            speed: cell seconds per wall second.
            figures: of the application.
            containers: ids of those that objects are put into; empty: unknown, all.
            fills: whether the task moves all objects into containers.
        """
        self.figures = figures or Figures()
        self.cell = cell
        self.seed = seed
        self.speed = speed
        self.status = TaskStatus()
        self.ready: float | None = None  # wall time from the start of this process until the cell was ready [s]
        self.first_motion: float | None = None  # wall time since the start of this process [s]
        self.truth = Truth(tuple(containers))
        self.fills = fills
        self.rejected = Rejected()
        self.restarts: dict[str, int] = {}
        self.continued = ""  # file of the simulated world of an earlier run from which this one continued
        self.failed = False  # whether the cell did not come up
        self.chaos: list[dict[str, object]] | None = None  # injected faults, if enabled
        self._latencies = array("d")  # [ms]
        self._before = Counted()  # of earlier lives of the task's process
        self._now = Counted()
        self._task_since: float | None = None  # cell time [s]
        self._task_until = 0.0  # cell time [s]

    def on_status(self, status: TaskStatus) -> None:
        """Add a task status."""
        figures = Counted.of(status)
        if figures.restarted_since(self._now):
            self._before = self._before + self._now
        self._now = figures
        self.status = status
        if status.started:
            stamp = status.header.stamp * 1e-9
            if self._task_since is None:
                self._task_since = stamp - status.task_seconds
            self._task_until = stamp

    def on_motion(self, time: float, status: MotionStatus) -> None:
        """Add a motion status; `time` is wall time since the start of this process [s]."""
        if status.state == "active" and self.first_motion is None:
            self.first_motion = time

    def on_rejections(self, _time: float, rejections: Rejections) -> None:
        """Add rejected targets."""
        self.rejected.add(rejections.rejected)

    def on_latency(self, milliseconds: float) -> None:
        """Add the time from a frame's exposure to the arrival of the targets detected in it [ms]."""
        if len(self._latencies) == MAX_LATENCIES:
            del self._latencies[: MAX_LATENCIES // 2]
        self._latencies.append(milliseconds)

    @property
    def state(self) -> str:
        """State of the task; ERROR if the cell did not come up."""
        return "ERROR" if self.failed else self.status.state

    @property
    def unexplained(self) -> list[list[float]]:
        """Positions [m] of objects that a task left though it is DONE and did not reject them, by ground truth."""
        if not (self.fills and self.state == "DONE"):
            return []
        explained = [_xyz(place.position) for place in self._all_rejected().places]
        return [[round(value, 4) for value in each.position] for each in self.truth.left(explained)]

    def _all_rejected(self) -> Rejected:
        rejected = Rejected(list(self.rejected.places))
        rejected.add(self.status.skipped)
        if self.truth.objects is not None:  # one that was carried across the border of an image is not left there
            rejected.places = [place for place in rejected.places if place.reason != PARTLY_OUT_OF_VIEW
                               or self.truth.is_left_at(_xyz(place.position))]
        return rejected

    def write(self, file: Path) -> None:
        """Write the summary as JSON, atomically."""
        part = file.with_name(file.name + ".part")
        part.write_text(json.dumps(self.as_dict(), indent=2) + "\n", encoding="utf-8")
        part.replace(file)

    def as_dict(self) -> dict[str, Any]:
        """Return the content of the summary file."""
        rejected, truth, world = self._all_rejected(), self.truth.counted(), self.truth.world
        placed = self.figures.in_place(world) if world is not None else None
        if truth is not None and world is not None and placed is not None:
            for each in placed:
                truth["on_table" if each.state == "table" else "elsewhere"] -= 1
            truth |= {"in_place": len(placed),
                      "achieved": f"{len(placed)} of {len(world.objects)} {self.figures.IN_PLACE}"}
        figures = self._before + self._now
        seconds = self._task_until - self._task_since if self._task_since is not None else 0.0
        return {
            "cell": self.cell,
            "state": self.state,
            "placed": self.status.done,
            "targets": self.status.total,
            "rejected": [{"position": _xyz(place.position), "reason": place.reason} for place in rejected.places],
            "failures": figures.failures,
            "retries": figures.retries,
            "seconds": {
                "ready": _rounded(self.ready),
                "first_motion": _rounded(self.first_motion),
                "task": _rounded(seconds),
                "moving": _rounded(figures.moving),
                "planning": _rounded(figures.planning),
            },
            "plans": [plan.model_dump() for plan in figures.plans],
            "frame_to_target_ms": {
                "p50": _rounded(percentile(self._latencies, 0.50)),
                "p99": _rounded(percentile(self._latencies, 0.99)),
            },
            "restarts": dict(self.restarts),
            "seed": self.seed,
            "speed": self.speed,
            "truth": truth,
            "figures": dict(self.status.figures),
            "overlooked": self.status.overlooked,
            "unexplained": self.unexplained,
            **({"problem": self.status.message} if self.state == "ERROR" and self.status.message else {}),
            **({"continued": self.continued} if self.continued else {}),
            **self.figures.blocks(),
            **({"chaos": list(self.chaos)} if self.chaos is not None else {}),
        }


def percentile(values: Sequence[float], fraction: float) -> float | None:
    """Return the percentile for a fraction (nearest rank); None without values."""
    if not values:
        return None
    return sorted(values)[max(0, math.ceil(fraction * len(values)) - 1)]


def describe(summary: dict[str, Any], application: Figures) -> list[str]:
    """Return a summary as a few lines of text.

    Args:
        summary: content of a summary file.
        application: provides the headline.
    """
    seconds = summary["seconds"]
    lines = [f"{summary['cell']}: {summary['state']}, {application.headline(summary)}"]
    if summary.get("problem"):
        lines.append(f"  {summary['problem']}")
    if summary["figures"]:
        lines.append("  " + ", ".join(f"{name} {value}" for name, value in summary["figures"].items()))
    for place in summary["rejected"]:
        x, y, z = place["position"]
        lines.append(f"  left at ({x:.3f}, {y:.3f}, {z:.3f}): {place['reason']}")
    if summary.get("overlooked"):
        lines.append(f"  {summary['overlooked']}")
    for x, y, z in summary.get("unexplained", ()):
        lines.append(f"  left at ({x:.3f}, {y:.3f}, {z:.3f}): not reported by the task")
    if summary.get("continued") and summary["state"] == "DONE" and seconds["first_motion"] is None:
        lines.append(f"  nothing was left to do in the simulated world of an earlier run, {summary['continued']}: "
                     "`zencell world reset` in `zencell up`, or a run without ZENCELL_STATE, has the first layout")
    times = [
        f"ready {_seconds(seconds['ready'])}",
        f"first motion {_seconds(seconds['first_motion'])}",
        f"task {_seconds(seconds['task'])}",
        f"moving {_seconds(seconds['moving'])}",
        f"planning {_seconds(seconds['planning'])} in {len(summary['plans'])} plans",
    ]
    lines.append("  " + ", ".join(times))
    if summary["failures"] or summary["retries"]:
        lines.append(f"  {summary['failures']} failures, {summary['retries']} retries")
    if summary["frame_to_target_ms"]["p50"] is not None:
        latency = summary["frame_to_target_ms"]
        lines.append(f"  frame to target {latency['p50']:.1f} ms (median), {latency['p99']:.1f} ms (99 %)")
    if "chaos" in summary:
        lines.append(f"  {len(summary['chaos'])} injected faults")
    if restarted := {name: count for name, count in summary["restarts"].items() if count}:
        lines.append("  restarts: " + ", ".join(f"{name} {count} x" for name, count in restarted.items()))
    return lines


def _seconds(value: float | None) -> str:
    return "never" if value is None else f"{value:.1f} s"


def _rounded(value: float | None) -> float | None:
    return None if value is None else round(value, 3)


def _xyz(position: Vector3) -> list[float]:
    return [round(position.x, 4), round(position.y, 4), round(position.z, 4)]


def _place(position: Vector3) -> tuple[float, float, float]:
    return position.x, position.y, position.z
