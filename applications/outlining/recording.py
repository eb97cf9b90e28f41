"""What summaries, reports and Foxglove recordings show of outlining."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from applications.outlining.topics import CONTOUR_PATH, OUTLINE_STATUS, OutlinePoints, OutlineStatus
from common.config import RobotConfig
from common.messages import Color, JointState, TaskStatus, WorldObjects
from common.topics import JOINT_STATES, SCENE_OBJECTS, Topic
from recording.foxglove import closed_line, entity, update
from recording.report import application

if TYPE_CHECKING:
    from recording.report.history import RunHistory

Array = NDArray[np.float64]

BEFORE = ("IDLE", "SELECTING", "PLANNING")
UNDER_WAY = ("APPROACHING", "TRACING", "RETREATING")
CLOSED = 1e-3  # [m] distance of first and last point of a closed outline, besides the motion between two joint states
MAX_GAP = 2.0  # [s] at start and end without joint states, in which the tool may have moved on
MOST_STATES = 100_000  # joint states of one outline: a quarter of an hour at 100 Hz


class OutlineFigures(application.Figures):
    """Block "outline" of a summary, and the section of a report."""

    STATE_COLORS: ClassVar = {
        "SELECTING": "#e6c229", "PLANNING": "#e6c229", "APPROACHING": "#2f7ed8", "TRACING": "#17a398",
        "RETREATING": "#8d6cc2", "HOMING": "#8d6cc2",
    }

    def __init__(self, robot: RobotConfig | None = None, *, for_report: bool = False) -> None:
        """Start without data; without a robot only the task's own figures are known."""
        super().__init__(robot, for_report=for_report)
        self.traced = TraceEvaluation(robot)

    def listeners(self) -> dict[Topic[Any], Callable[[float, Any], None]]:
        """Return listeners for task, contour, joints and ground truth."""
        traced = self.traced
        return {
            OUTLINE_STATUS: lambda _, status: traced.on_status(status),
            CONTOUR_PATH: lambda _, path: traced.on_path(path),
            SCENE_OBJECTS: lambda _, truth: traced.on_truth(truth),
            **({JOINT_STATES: lambda _, state: traced.on_joints(state)} if self.robot is not None else {}),
        }

    def exposed(self, message: OutlinePoints) -> int:
        """Return the stamp of the image of a contour; 0 for coordinates from a file."""
        return 0 if message.given else message.header.stamp

    def blocks(self) -> dict[str, Any]:
        """Return the traced fraction and the accuracy."""
        return {"outline": self.traced.figures()}

    def progress(self, status: TaskStatus) -> str:
        """Return a line such as "TRACING Object_1, 0.400 m"."""
        assert isinstance(status, OutlineStatus)
        return f"{status.state} {status.object}, {status.length_m:.3f} m" if status.object else status.state

    def headline(self, summary: Mapping[str, Any]) -> str:
        """Return what was traced and how accurately."""
        outline = summary["outline"]
        if not outline["object"]:
            return "nothing outlined"
        text = f"{outline['object']} outlined: {outline['fraction']:.1%} of {outline['length_m']:.3f} m"
        for what, name in (("deviation_mm", "the true outline"), ("tracking_mm", "the contour")):
            if figures := outline[what]:
                text += f", {figures['mean']:.2f} mm from {name} ({figures['max']:.2f} mm at most)"
        return text

    def facts(self, summary: Mapping[str, Any]) -> list[tuple[str, str]]:
        """Return the same as labeled values."""
        outline = summary["outline"]
        traced = f"{outline['fraction']:.1%} of {outline['length_m']:.3f} m"
        facts = [("outlined", outline["object"] or "nothing"), ("traced", traced)]
        for what, name in (("deviation_mm", "from the true edge"), ("tracking_mm", "from the contour")):
            if figures := outline[what]:
                facts.append((name, f"{figures['mean']:.2f} mm ({figures['max']:.2f} at most)"))
        return facts

    def picture(self, run: RunHistory, tool: Array) -> application.Section:
        """Return a top view of the detected contour and the motion of the tool tip along it."""
        return application.Section("outline", "Outline", (
            f"{self.traced.picture()}<p>{self.traced.figures()['points']} points of the contour; the true edge is "
            "shown for comparison only.</p>"
        ))


class TraceEvaluation:
    """Evaluates the newest outline of a cell: motion of the tool tip against contour and ground truth.

    The ground truth is used for this evaluation only.
    """

    def __init__(self, robot: RobotConfig | None) -> None:
        """Start without data.

        Args:
            robot: whose tool tip traces; None if unknown.
        """
        self._robot = robot
        self._status = OutlineStatus()
        self._path: OutlinePoints | None = None
        self._truth: WorldObjects | None = None  # when the arm started to approach
        self._newest_truth: WorldObjects | None = None
        self._states: list[JointState] = []
        self._began: int | None = None  # stamps of the statuses between which the outline was traced [ns]
        self._ended: int | None = None

    def on_status(self, status: OutlineStatus) -> None:
        """Record the state of the task."""
        before, self._status = self._status.state, status
        if status.state == before:
            return
        if status.state == "APPROACHING":
            self._states, self._began, self._ended = [], None, None
            self._truth = self._newest_truth  # the operator may move the object later
        elif status.state == "TRACING":
            self._began = status.header.stamp
        elif before == "TRACING":
            self._ended = status.header.stamp

    def on_path(self, path: OutlinePoints) -> None:
        """Record the contour; once the arm moves it may occlude a part of it."""
        if path.poses and self._status.state in BEFORE:
            self._path = path

    def on_truth(self, truth: WorldObjects) -> None:
        """Record the ground truth."""
        self._newest_truth = truth

    def on_joints(self, state: JointState) -> None:
        """Record joint states. They arrive out of order with the statuses; their stamps decide later."""
        if self._status.state in UNDER_WAY and len(self._states) < MOST_STATES:
            self._states.append(state)

    def figures(self) -> dict[str, Any]:
        """Return the block "outline" of a summary; deviations are None without a trace or a ground truth."""
        times, tips = self._tips()
        tips[:, 2] -= self._status.standoff
        path, outlines = self._path_points(), self._outlines()
        near = [distances(tips, points) for points in outlines] if len(tips) else []
        return {
            "object": self._status.object,
            "points": self._status.points,
            "fraction": round(self._fraction(tips), 4),
            "length_m": round(self._status.length_m, 4),
            "closed": self._status.closed and (self._robot is None or _is_closed(tips, times)),
            "deviation_mm": _millimetres(min(near, key=lambda d: float(d.mean()), default=None)),
            "tracking_mm": _millimetres(distances(tips, path) if len(tips) and len(path) > 1 else None),
        }

    def picture(self) -> str:
        """Return an `svg` element with contour, true edges and motion of the tool tip from above."""
        import matplotlib as mpl
        from matplotlib.figure import Figure

        from recording.report.charts import LINES, QUIET, STYLE, from_above, svg

        contour, (_, tips), edges = self._path_points(), self._tips(), self._outlines()
        with mpl.rc_context(STYLE):
            figure = Figure(figsize=(7.5, 6.0), layout="constrained")
            axes = figure.subplots()
            lines = [(edge, QUIET, 0.8, 1.0, "true edge") for edge in edges]
            lines += [(contour, "#e6a229", 3.0, 0.7, "detected contour")] if len(contour) else []
            for line, color, width, alpha, label in lines:
                closed = np.vstack([line, line[:1]])
                axes.plot(closed[:, 1], closed[:, 0], color=color, linewidth=width, alpha=alpha, label=label)
            if len(tips):
                axes.plot(tips[:, 1], tips[:, 0], color=LINES[0], linewidth=1.0, label="traced")
            shown = [part[:, :2] for part in (contour, tips) if len(part)]
            if shown:
                low, high = np.vstack(shown).min(axis=0) - 0.03, np.vstack(shown).max(axis=0) + 0.03
                axes.set_xlim(low[1], high[1])
                axes.set_ylim(low[0], high[0])
            from_above(figure, axes)
            return svg(figure, "outline")

    def _fraction(self, tips: Array) -> float:
        """Return the traced fraction of the contour; the status has the planned fraction."""
        if self._status.closed or not self._status.length_m or self._robot is None:
            return self._status.fraction
        way = float(np.linalg.norm(np.diff(tips, axis=0), axis=1).sum()) if len(tips) > 1 else 0.0
        return min(self._status.fraction, way / self._status.length_m)

    def _tips(self) -> tuple[Array, Array]:
        """Return times (N + 2,) [s] and positions (N, 3) [m] of the tool tip; the outer times are start and end."""
        began, ended = self._began, self._ended
        if began is None or self._robot is None:
            return np.zeros(2), np.zeros((0, 3))
        from common.robot.model import RobotModel  # slow import, only when needed

        robot = RobotModel.load(self._robot)
        stamps, tips = [], []
        for state in self._states:
            q = robot.order(state.name, state.position)
            if q is not None and began <= state.header.stamp and (ended is None or state.header.stamp <= ended):
                stamps.append(state.header.stamp)
                tips.append(robot.fk(q)[:3, 3])
        last = ended if ended is not None else max(stamps, default=began)
        return 1e-9 * (np.array([began, *stamps, last]) - began), np.array(tips).reshape(-1, 3)

    def _path_points(self) -> Array:
        poses = self._path.poses if self._path else []
        return np.array([(p.position.x, p.position.y, p.position.z) for p in poses]).reshape(-1, 3)

    def _outlines(self) -> list[Array]:
        """Return the edges (n, 3) [m] of the true top faces, outer and inner."""
        truth = self._truth or self._newest_truth
        objects = truth.objects if truth else []
        edges: list[tuple[Sequence[tuple[float, float]], float]] = []
        for thing in objects:
            edges += [(edge, thing.base + thing.height) for edge in (thing.outline, thing.hole) if len(edge) > 2]
        return [np.column_stack([np.array(edge), np.full(len(edge), top)]) for edge, top in edges]


def _is_closed(tips: Array, times: Array) -> bool:
    """Return whether the first and the last position (N, 3) are equal, within what the joint states can show.

    Between the start and the first joint state, and between the last one and the end, the tool may have moved at its
    highest observed speed, for MAX_GAP at most. `times` (N + 2,) [s]: start, those of the positions, end.
    """
    if len(tips) < 2:
        return False
    steps = np.linalg.norm(np.diff(tips, axis=0), axis=1)
    gaps = np.diff(times)
    speed = float((steps / np.maximum(gaps[1:-1], 1e-3)).max())
    unseen = float(steps.max()) + speed * min(float(gaps[0] + gaps[-1]), MAX_GAP)
    return float(np.linalg.norm(tips[0] - tips[-1])) <= CLOSED + unseen


def distances(places: Array, corners: Array) -> Array:
    """Return the distances (N,) [m] of positions (N, 3) from the closed polyline through corners (M, 3)."""
    edges = np.roll(corners, -1, axis=0) - corners
    squares = np.maximum((edges**2).sum(axis=1), 1e-18)
    nearest = np.empty(len(places))
    for i, place in enumerate(places):
        offset = place - corners
        share = np.clip((offset * edges).sum(axis=1) / squares, 0.0, 1.0)
        nearest[i] = np.sqrt(((offset - share[:, None] * edges) ** 2).sum(axis=1).min())
    return nearest


def _millimetres(values: Array | None) -> dict[str, float] | None:
    if values is None:
        return None
    return {"mean": round(1e3 * float(values.mean()), 4), "max": round(1e3 * float(values.max()), 4)}


COLOR = Color(r=0.1, g=0.9, b=0.3)


def of_outline(message: OutlinePoints) -> dict[str, Any]:
    """Convert an outline to a closed line."""
    points = [(pose.position.x, pose.position.y, pose.position.z) for pose in message.poses]
    lines, stamp = [closed_line(points, COLOR)] if points else [], message.header.stamp
    return update(stamp, [entity(message.object or "outline", message.header.frame_id, stamp, lines=lines)])


FOXGLOVE = [(OutlinePoints, "foxglove.SceneUpdate", of_outline)]
