"""Figures of a traced outline: of a tool tip whose way is known, against a path and a truth that are known."""

from __future__ import annotations

import asyncio
import json
import math

import numpy as np
import pytest

from applications.outlining.recording import OutlineFigures, TraceEvaluation, distances
from applications.outlining.topics import CONTOUR_PATH, OUTLINE_STATUS, OutlinePoints, OutlineStatus
from common import messages as m
from common import topics
from common.application import find_application
from common.config import load_cell
from common.planning.ik import solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import rpy_to_matrix, transform
from common.transport.local import LocalNetwork
from recording.report.aggregator import Collector, RunAggregator
from recording.report.summary import describe

CELL = load_cell("ur5")
ROBOT = RobotModel.load(CELL.robot)
TOP = 1.1
SQUARE = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)]


def joints_at(x: float, y: float, z: float, stamp: int) -> m.JointState:
    q = solve_ik(ROBOT, transform(rpy_to_matrix(0, -math.pi, -math.pi), (x, y, z)), ROBOT.named("home"))
    assert q is not None
    return m.JointState(header=m.Header(stamp=stamp), name=ROBOT.joint_names, position=q.tolist())


def status(state: str, stamp: int, **values: object) -> OutlineStatus:
    return OutlineStatus.model_validate({
        "header": m.Header(stamp=stamp), "state": state, "started": True, "object": "Object_1", "points": 4,
        "fraction": 1.0, "length_m": 0.4, **values})


def path(shift: float = 0.0, stamp: int = 0) -> OutlinePoints:
    poses = [m.Pose(position=m.Vector3(x=x + shift, y=y, z=TOP)) for x, y in SQUARE]
    return OutlinePoints(header=m.Header(stamp=stamp), poses=poses, object="Object_1")


def truth(shift: float = 0.0) -> m.WorldObjects:
    cube = m.WorldObject(id="cube", shape="box", outline=[(x + shift, y) for x, y in SQUARE], base=1.0, height=0.1)
    other = m.WorldObject(id="other", shape="cylinder", outline=[(0.1, 0.3), (0.2, 0.3), (0.2, 0.4)], base=0, height=1)
    return m.WorldObjects(objects=[other, cube])


def traced(standoff: float = 0.0, off: float = 0.0, there: m.WorldObjects | None = None) -> TraceEvaluation:
    """A square that was traced at its corners, `off` [m] outside of it in x; `there` is what really was there."""
    follower = TraceEvaluation(CELL.robot)
    follower.on_path(path())
    follower.on_truth(there or truth())
    follower.on_status(status("APPROACHING", 10, standoff=standoff))
    follower.on_joints(joints_at(0.5, 0.0, 1.2, 11))
    follower.on_status(status("TRACING", 20, standoff=standoff))
    for k, (x, y) in enumerate([*SQUARE, SQUARE[0]]):
        follower.on_joints(joints_at(x + math.copysign(off, x - 0.5), y, TOP + standoff, 21 + k))
    follower.on_status(status("RETREATING", 30, standoff=standoff, closed=True))
    follower.on_joints(joints_at(0.5, 0.0, 1.2, 31))
    follower.on_path(OutlinePoints(poses=[m.Pose()] * 3, object="arm"))
    follower.on_status(status("DONE", 40, standoff=standoff, closed=True))
    follower.on_path(OutlinePoints(poses=[m.Pose()] * 3, object="arm"))
    return follower


def test_only_joint_states_while_tracing_count() -> None:
    figures = traced().figures()
    assert figures["object"] == "Object_1" and figures["closed"] and figures["fraction"] == 1.0
    assert (figures["points"], figures["length_m"]) == (4, 0.4)
    assert figures["deviation_mm"]["max"] < 0.02
    assert figures["tracking_mm"]["max"] < 0.02
    json.dumps(figures)


def test_tool_offset_of_one_millimeter_is_measured() -> None:
    figures = traced(off=0.001).figures()
    assert figures["deviation_mm"]["mean"] == pytest.approx(1.0, abs=0.02)
    assert figures["tracking_mm"]["max"] == pytest.approx(1.0, abs=0.02)


def test_contour_error_is_deviation_not_tracking() -> None:
    figures = traced(there=truth(shift=0.002)).figures()
    assert figures["deviation_mm"]["max"] == pytest.approx(2.0, abs=0.03)
    assert figures["tracking_mm"]["max"] < 0.02


def test_standoff_is_no_deviation() -> None:
    assert traced(standoff=0.01).figures()["deviation_mm"]["max"] < 0.02


def test_inner_edge_of_a_ring_is_compared_with_the_edge_of_its_hole() -> None:
    around = [(x + math.copysign(0.02, x - 0.5), y + math.copysign(0.02, y)) for x, y in SQUARE]
    ring = m.WorldObject(id="ring", shape="ring", outline=around, hole=SQUARE, base=1.0, height=0.1)
    assert traced(there=m.WorldObjects(objects=[ring])).figures()["deviation_mm"]["max"] < 0.02


def test_object_moved_after_the_approach_is_evaluated_at_its_old_position() -> None:
    follower = traced()
    follower.on_truth(truth(shift=0.05))
    assert follower.figures()["deviation_mm"]["max"] < 0.02


def test_outline_that_ends_elsewhere_is_not_closed() -> None:
    follower = traced()
    follower._states = [s for s in follower._states if s.header.stamp < 24]
    assert not follower.figures()["closed"]


def test_outline_with_lost_first_joint_states_counts_as_closed_within_speed() -> None:
    def is_closed(missing: float, end: float) -> bool:
        """Whether a square that is traced at 0.05 m/s until `end` [s] counts as closed without its first states."""
        follower, second = TraceEvaluation(CELL.robot), 1_000_000_000
        follower.on_path(path())
        follower.on_status(status("APPROACHING", 0))
        follower.on_status(status("TRACING", second))
        corners = np.array([*SQUARE, SQUARE[0]])
        for time in np.arange(missing, end + 1e-9, 0.25):
            side, rest = divmod(min(0.05 * time, 0.4 - 1e-9), 0.1)
            x, y = corners[int(side)] + rest / 0.1 * (corners[int(side) + 1] - corners[int(side)])
            follower.on_joints(joints_at(float(x), float(y), TOP, second + int(time * second)))
        follower.on_status(status("RETREATING", second + int(8 * second), closed=True))
        return bool(follower.figures()["closed"])

    assert is_closed(0.0, 8.0) and is_closed(1.0, 8.0)
    assert not is_closed(0.0, 4.0)


def test_no_deviation_without_trace_or_truth() -> None:
    empty = TraceEvaluation(CELL.robot).figures()
    assert (empty["deviation_mm"], empty["tracking_mm"], empty["closed"], empty["object"]) == (None, None, False, "")
    follower = traced(there=m.WorldObjects())
    assert follower.figures()["deviation_mm"] is None
    assert follower.figures()["tracking_mm"] is not None


def test_distance_includes_the_closing_side_of_a_polyline() -> None:
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=float)
    places = np.array([(0.5, 0, 0), (0, 0.5, 0), (0.5, 0.4, 0), (2, 2, 0), (0.5, 1, 0.3)])
    assert np.allclose(distances(places, square), [0, 0, 0.4, math.sqrt(2), 0.3])


def test_progress_of_an_outline_in_one_line() -> None:
    assert OutlineFigures().progress(status("TRACING", 1)) == "TRACING Object_1, 0.400 m"
    assert OutlineFigures().progress(OutlineStatus(started=True, state="SELECTING")) == "SELECTING"


def test_without_a_robot_only_task_figures_are_known() -> None:
    figures = OutlineFigures()
    figures.listeners()[OUTLINE_STATUS](0.0, status("DONE", 1, closed=True, fraction=0.75))
    outline = figures.blocks()["outline"]
    assert outline["object"] == "Object_1" and outline["closed"] and outline["fraction"] == 0.75
    assert outline["deviation_mm"] is None and outline["tracking_mm"] is None


def test_outline_from_a_file_has_no_image_stamp() -> None:
    assert OutlineFigures().exposed(path(stamp=5)) == 5
    assert OutlineFigures().exposed(path(stamp=5).model_copy(update={"given": True})) == 0


async def test_collector_follows_an_outline_to_its_end() -> None:
    net = LocalNetwork()
    cell = net.bus("cell", cell="test")
    fold = RunAggregator("test", find_application("outlining"), robot=CELL.robot)
    assert isinstance(fold.figures, OutlineFigures)
    bus, lines = net.bus("supervisor", cell="test"), asyncio.Queue[str]()
    collector = Collector(bus, fold, 0.0, lines.put_nowait)
    listening = asyncio.create_task(collector.run())
    cell.writer(topics.SCENE_OBJECTS).put(truth())
    statuses, states = cell.writer(OUTLINE_STATUS), cell.writer(topics.JOINT_STATES)
    cell.writer(CONTOUR_PATH).put(path())
    async with asyncio.timeout(20):
        for state, stamp in (("PLANNING", 5), ("APPROACHING", 10), ("TRACING", 20)):
            statuses.put(status(state, stamp))
            assert state in await lines.get()
        for k, (x, y) in enumerate([*SQUARE, SQUARE[0]]):
            states.put(joints_at(x, y, TOP, 21 + k))
            while len(fold.figures.traced._states) <= k:  # noqa: ASYNC110
                await asyncio.sleep(0.001)
        statuses.put(status("DONE", 30, closed=True))
        await collector.ended.wait()
    listening.cancel()
    figures = fold.summary.as_dict()
    assert figures["outline"]["closed"]
    assert figures["outline"]["deviation_mm"]["max"] < 0.02
    assert describe(figures, fold.figures)[0].startswith("test: DONE, Object_1 outlined: 100.0% of 0.400 m, 0.0")


def test_interrupted_trace_counts_its_traced_fraction() -> None:
    follower = TraceEvaluation(CELL.robot)
    follower.on_path(path())
    follower.on_status(status("TRACING", 20))
    for k, (x, y) in enumerate(SQUARE[:2]):
        follower.on_joints(joints_at(x, y, TOP, 21 + k))
    figures = follower.figures()
    assert abs(figures["fraction"] - 0.25) < 0.002
    assert not figures["closed"]
