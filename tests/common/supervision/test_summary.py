import asyncio
import json
import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from common import topics
from common.application import all_topics
from common.applications.pick_place.messages import PickPlaceStatus
from common.applications.pick_place.topics import PICK_PLACE_STATUS, REJECTED_TARGETS, SCENE_BALLS, VALIDATED_TARGETS
from common.clock import Clock
from common.messages import (
    Header,
    MotionStatus,
    PlanFigure,
    Pose,
    PoseArray,
    Rejection,
    Rejections,
    ServiceCounters,
    Vector3,
)
from common.supervision.collector import Collector
from common.supervision.rates import Rates
from common.supervision.summary import Rejected, Summary, count_truth, describe, percentile, progress_line
from common.transport.local import LocalNetwork

PLAN = PlanFigure(planner="cartesian", seconds=0.01, fraction=1.0, attempts=1)


def at(x: float, y: float, reason: str = "too far") -> Rejection:
    return Rejection(position=Vector3(x=x, y=y, z=0.03), reason=reason)


def balls(*labels: str) -> PoseArray:
    return PoseArray(poses=[Pose()] * len(labels), labels=list(labels))


def status(state: str, seconds: float, **values: object) -> PickPlaceStatus:
    fields = {"header": Header(stamp=int(seconds * 1e9)), "state": state, "started": True, **values}
    return PickPlaceStatus.model_validate(fields)


def test_summary_has_the_fields_that_scripts_read() -> None:
    summary = Summary("panda", 3, 5.0).as_dict()
    assert list(summary) == [
        "cell", "state", "placed", "targets", "rejected", "failures", "retries", "seconds", "plans",
        "frame_to_target_ms", "restarts", "seed", "speed", "truth",
    ]
    assert list(summary["seconds"]) == ["ready", "first_motion", "task", "moving", "planning"]
    assert list(summary["frame_to_target_ms"]) == ["p50", "p99"]
    assert summary["truth"] is None
    json.dumps(summary)


def test_a_place_is_listed_once_and_what_lies_in_the_box_never() -> None:
    rejected = Rejected()
    rejected.add([at(0.9, 0.0), at(0.9, 0.02), at(0.9, 0.1), at(0.55, 0.25, "inside the container")])
    rejected.add([at(0.905, 0.0, "partly out of view")])
    assert [(place.position.y, place.reason) for place in rejected.places] == [
        (0.0, "partly out of view"), (0.1, "too far")
    ]


@given(st.lists(st.tuples(st.floats(-1, 1), st.floats(-1, 1)), max_size=20))
def test_listed_places_are_never_close_to_each_other(points: list[tuple[float, float]]) -> None:
    rejected = Rejected()
    for x, y in points:
        rejected.add([at(x, y)])
    # A newer rejection of a place may lie up to the limit from where the first was seen.
    assert len(rejected.places) <= len(points)
    for index, a in enumerate(rejected.places):
        assert all(a is not b for b in rejected.places[:index])


def test_skipped_targets_are_reported_with_the_rejected() -> None:
    summary = Summary("panda", 0, 1.0)
    summary.rejected.add([at(0.9, 0.0)])
    summary.on_status(status("DONE", 10, skipped=[at(0.4, -0.3, "no path"), at(0.9, 0.01, "no path")]))
    assert [place["reason"] for place in summary.as_dict()["rejected"]] == ["no path", "no path"]


def test_figures_of_a_task_that_was_restarted_add_up() -> None:
    summary = Summary("panda", 0, 1.0)
    first = {"task_seconds": 10, "moving_seconds": 8, "failures": 1, "plans": [PLAN] * 3, "placed": 2}
    summary.on_status(status("GRASPING", 100, **first))
    summary.on_status(status("GRASPING", 105, task_seconds=1, moving_seconds=0, placed=2))
    summary.on_status(status("DONE", 120, task_seconds=16, moving_seconds=9, retries=1, plans=[PLAN] * 4, placed=7))
    figures = summary.as_dict()
    assert (figures["placed"], figures["failures"], figures["retries"], len(figures["plans"])) == (7, 1, 1, 7)
    assert figures["seconds"]["moving"] == 17
    assert figures["seconds"]["task"] == 30  # from its first start, the time in between included


def test_only_the_first_motion_counts() -> None:
    summary = Summary("panda", 0, 1.0)
    summary.on_motion(MotionStatus(state="none"), 3.0)
    summary.on_motion(MotionStatus(state="active"), 4.5)
    summary.on_motion(MotionStatus(state="active"), 9.0)
    assert summary.as_dict()["seconds"]["first_motion"] == 4.5


def test_truth_is_counted_by_where_balls_lie() -> None:
    assert count_truth(balls("box", "box", "table", "held", "falling")) == {
        "in_box": 2, "on_table": 1, "elsewhere": 2
    }
    assert count_truth(None) is None


@given(st.lists(st.floats(0, 1e6), min_size=1), st.floats(0.01, 1))
def test_percentile_is_a_value_with_that_much_below_it(values: list[float], fraction: float) -> None:
    found = percentile(values, fraction)
    assert found in values
    assert sum(value <= found for value in values) >= math.floor(fraction * len(values))


def test_lines_for_people_name_what_was_left_and_what_was_restarted() -> None:
    summary = Summary("panda", 0, 1.0)
    summary.on_status(status("DONE", 10, placed=6, targets=6))
    summary.rejected.add([at(0.9, 0.0)])
    summary.truth = balls(*["box"] * 6, "table")
    summary.restarts = {"router": 0, "scene_manager": 2}
    text = "\n".join(describe(summary.as_dict()))
    assert "panda: DONE, 6 of 6 placed (truth: 6 in the box, 1 on the table)" in text
    assert "left at (0.900, 0.000, 0.030): too far" in text
    assert "scene_manager 2 x" in text
    assert "router" not in text


@pytest.mark.parametrize(
    ("values", "line"),
    [
        ({"placed": 3, "targets": 7, "state": "GRASPING", "target": "ball_4", "started": True},
         "3 of 7 placed - GRASPING ball_4"),
        ({"targets": 2}, "0 of 2 placed - IDLE (waits for `zencell task start`)"),
        ({"paused": True, "started": True}, "0 of 0 placed - IDLE (paused)"),
    ],
)
def test_progress_in_one_line(values: dict[str, object], line: str) -> None:
    assert progress_line(PickPlaceStatus.model_validate(values)) == line


def test_rates_come_from_what_readers_count() -> None:
    rates = Rates(all_topics())
    for second in range(3):
        received = {"camera/image_raw": 10 * second, "joint_states": 100 * second}
        rates.update(ServiceCounters(service="vision_detector", received=received), float(second))
    assert rates.busiest_of("camera_simulator") == ("camera/image_raw", 10.0)
    assert rates.busiest_of("trajectory_executor") == ("joint_states", 100.0)
    assert rates.busiest_of("smart_pick_place") is None
    rates.update(ServiceCounters(service="vision_detector", received={"camera/image_raw": 0}), 3.0)
    assert rates.of_topic("camera/image_raw") == 0.0  # it was started again


async def test_collector_hears_the_cell_and_waits_for_what_still_falls() -> None:
    net = LocalNetwork()
    clock = Clock(2.0)
    cell = net.bus("cell", cell="test", clock=clock)
    summary = Summary("test", 0, 2.0)
    progress: list[str] = []
    bus = net.bus("supervisor", cell="test", clock=clock)
    collector = Collector(bus, "smart_pick_place", summary, 0.0, progress.append)
    listening = asyncio.create_task(collector.run())
    truth = cell.writer(SCENE_BALLS)
    truth.put(balls("box", "falling"))
    cell.writer(REJECTED_TARGETS).put(Rejections(header=cell.header(), rejected=[at(0.9, 0.0)]))
    cell.writer(topics.MOTION_STATUS).put(MotionStatus(state="active"))
    stamp = clock.now_ns() - int(0.020 * 2.0 * 1e9)
    cell.writer(VALIDATED_TARGETS).put(PoseArray(header=Header(stamp=stamp)))
    cell.writer(PICK_PLACE_STATUS).put(status("DONE", 1, placed=2, targets=2))
    async with asyncio.timeout(10):
        await collector.ended.wait()
        settling = asyncio.create_task(collector.settle())
        await asyncio.sleep(0)
        truth.put(balls("box", "box"))
        await settling
    listening.cancel()
    figures = summary.as_dict()
    assert figures["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0}
    assert figures["rejected"] == [{"position": [0.9, 0.0, 0.03], "reason": "too far"}]
    assert figures["seconds"]["first_motion"] is not None
    assert figures["frame_to_target_ms"]["p50"] >= 20
    assert progress == ["2 of 2 placed - DONE"]
