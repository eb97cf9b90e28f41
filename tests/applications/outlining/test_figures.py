"""Figures of a traced outline: of a tool tip whose way is known, against a path and a truth that are known."""

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
SECOND = 1_000_000_000


def joints_at(x, y, z, stamp):
    q = solve_ik(ROBOT, transform(rpy_to_matrix(0, -math.pi, -math.pi), (x, y, z)), ROBOT.named("home"))
    return m.JointState(header=m.Header(stamp=stamp), name=ROBOT.joint_names, position=q.tolist())


def status(state, stamp, **values):
    return OutlineStatus.model_validate({
        "header": m.Header(stamp=stamp), "state": state, "started": True, "object": "Object_1", "points": 4,
        "fraction": 1.0, "length_m": 0.4, **values})


def path(stamp=0):
    poses = [m.Pose(position=m.Vector3(x=x, y=y, z=TOP)) for x, y in SQUARE]
    return OutlinePoints(header=m.Header(stamp=stamp), poses=poses, object="Object_1")


def truth(shift=0.0):
    cube = m.WorldObject(id="cube", shape="box", outline=[(x + shift, y) for x, y in SQUARE], base=1.0, height=0.1)
    other = m.WorldObject(id="other", shape="cylinder", outline=[(0.1, 0.3), (0.2, 0.3), (0.2, 0.4)], base=0, height=1)
    return m.WorldObjects(objects=[other, cube])


def ring():
    """A ring whose inner edge is the square."""
    around = [(x + math.copysign(0.02, x - 0.5), y + math.copysign(0.02, y)) for x, y in SQUARE]
    return m.WorldObjects(objects=[m.WorldObject(
        id="ring", shape="ring", outline=around, hole=SQUARE, base=1.0, height=0.1)])


def traced(standoff=0.0, off=0.0, world=None):
    """Evaluate a square that is traced at its corners, `off` [m] outside of it in x; `world` is the ground truth."""
    evaluation = TraceEvaluation(CELL.robot)
    evaluation.on_path(path())
    evaluation.on_truth(truth() if world is None else world)
    evaluation.on_status(status("APPROACHING", 10, standoff=standoff))
    evaluation.on_joints(joints_at(0.5, 0.0, 1.2, 11))
    evaluation.on_status(status("TRACING", 20, standoff=standoff))
    for k, (x, y) in enumerate([*SQUARE, SQUARE[0]]):
        evaluation.on_joints(joints_at(x + math.copysign(off, x - 0.5), y, TOP + standoff, 21 + k))
    evaluation.on_status(status("RETREATING", 30, standoff=standoff, closed=True))
    evaluation.on_joints(joints_at(0.5, 0.0, 1.2, 31))
    evaluation.on_path(OutlinePoints(poses=[m.Pose()] * 3, object="arm"))
    evaluation.on_status(status("DONE", 40, standoff=standoff, closed=True))
    evaluation.on_path(OutlinePoints(poses=[m.Pose()] * 3, object="arm"))
    return evaluation


def test_figures_of_a_trace_use_joint_states_while_tracing_only():
    evaluation = traced()
    evaluation.on_truth(truth(shift=0.05))  # the object is moved after the approach
    figures = evaluation.figures()
    assert figures["object"] == "Object_1" and figures["closed"] and figures["fraction"] == 1.0
    assert (figures["points"], figures["length_m"]) == (4, 0.4)
    json.dumps(figures)
    assert figures["deviation_mm"]["max"] < 0.02 and figures["tracking_mm"]["max"] < 0.02


@pytest.mark.parametrize(("situation", "deviation", "tracking"), [
    ({"off": 0.001}, 1.0, 1.0),
    ({"world": truth(shift=0.002)}, 2.0, 0.0),  # the contour was wrong
    ({"standoff": 0.01}, 0.0, 0.0),
    ({"world": ring()}, 0.0, 0.0),  # the nearest edge is that of its hole
])
def test_deviation_is_from_the_truth_and_tracking_from_the_path(situation, deviation, tracking):
    figures = traced(**situation).figures()
    assert figures["deviation_mm"]["max"] == pytest.approx(deviation, abs=0.03)
    assert figures["tracking_mm"]["max"] == pytest.approx(tracking, abs=0.02)
    assert "off" not in situation or figures["deviation_mm"]["mean"] == pytest.approx(1.0, abs=0.02)


@pytest.mark.parametrize(("missing", "end", "closed"), [(0.0, 8.0, True), (1.0, 8.0, True), (0.0, 4.0, False)])
def test_outline_counts_as_closed_though_its_first_joint_states_are_lost(missing, end, closed):
    """The square is traced at 0.05 m/s until `end` [s]."""
    evaluation = TraceEvaluation(CELL.robot)
    evaluation.on_path(path())
    evaluation.on_status(status("APPROACHING", 0))
    evaluation.on_status(status("TRACING", SECOND))
    corners = np.array([*SQUARE, SQUARE[0]])
    for time in np.arange(missing, end + 1e-9, 0.25):
        side, rest = divmod(min(0.05 * time, 0.4 - 1e-9), 0.1)
        x, y = corners[int(side)] + rest / 0.1 * (corners[int(side) + 1] - corners[int(side)])
        evaluation.on_joints(joints_at(float(x), float(y), TOP, SECOND + int(time * SECOND)))
    evaluation.on_status(status("RETREATING", SECOND + int(8 * SECOND), closed=True))
    assert bool(evaluation.figures()["closed"]) is closed


def test_interrupted_trace_counts_its_traced_fraction():
    evaluation = TraceEvaluation(CELL.robot)
    evaluation.on_path(path())
    evaluation.on_status(status("TRACING", 20))
    for k, (x, y) in enumerate(SQUARE[:2]):
        evaluation.on_joints(joints_at(x, y, TOP, 21 + k))
    figures = evaluation.figures()
    assert abs(figures["fraction"] - 0.25) < 0.002 and not figures["closed"]


def test_no_deviation_without_trace_truth_or_robot():
    empty = TraceEvaluation(CELL.robot).figures()
    assert (empty["deviation_mm"], empty["tracking_mm"], empty["closed"], empty["object"]) == (None, None, False, "")
    figures = traced(world=m.WorldObjects()).figures()
    assert figures["deviation_mm"] is None and figures["tracking_mm"] is not None
    without_robot = OutlineFigures()
    without_robot.listeners()[OUTLINE_STATUS](0.0, status("DONE", 1, closed=True, fraction=0.75))
    outline = without_robot.blocks()["outline"]
    assert outline["object"] == "Object_1" and outline["closed"] and outline["fraction"] == 0.75
    assert outline["deviation_mm"] is None and outline["tracking_mm"] is None


def test_distance_includes_the_closing_side_of_a_polyline():
    square = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], dtype=float)
    places = np.array([(0.5, 0, 0), (0, 0.5, 0), (0.5, 0.4, 0), (2, 2, 0), (0.5, 1, 0.3)])
    assert np.allclose(distances(places, square), [0, 0, 0.4, math.sqrt(2), 0.3])


def test_progress_is_one_line_and_an_outline_from_a_file_has_no_image_stamp():
    figures = OutlineFigures()
    assert figures.progress(status("TRACING", 1)) == "TRACING Object_1, 0.400 m"
    assert figures.progress(OutlineStatus(started=True, state="SELECTING")) == "SELECTING"
    assert figures.exposed(path(stamp=5)) == 5
    assert figures.exposed(path(stamp=5).model_copy(update={"given": True})) == 0


async def test_collector_follows_an_outline_to_its_end():
    net = LocalNetwork()
    cell, bus, lines = net.bus("cell", cell="test"), net.bus("supervisor", cell="test"), asyncio.Queue[str]()
    aggregator = RunAggregator("test", find_application("outlining"), robot=CELL.robot)
    collector = Collector(bus, aggregator, 0.0, lines.put_nowait)
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
            while len(aggregator.figures.traced._states) <= k:  # noqa: ASYNC110
                await asyncio.sleep(0.001)
        statuses.put(status("DONE", 30, closed=True))
        await collector.ended.wait()
    listening.cancel()
    figures = aggregator.summary.as_dict()
    assert figures["outline"]["closed"] and figures["outline"]["deviation_mm"]["max"] < 0.02
    line = describe(figures, aggregator.figures)[0]
    assert line.startswith("test: DONE, Object_1 outlined: 100.0% of 0.400 m, 0.0")
