"""Figures of a run come from the topics and the figures class of its application."""

import asyncio
import sys
from types import ModuleType

import pytest

from applications.pick_place.topics import (
    PICK_PLACE_STATUS,
    REJECTED_TARGETS,
    SCENE_BALLS,
    VALIDATED_TARGETS,
    PickPlaceStatus,
)
from common import messages as m
from common import topics
from common.application import Application, ApplicationTopics, find_application
from common.client.statistics import MOST_SERVICES, Rates
from common.clock import Clock
from common.topics import Topic
from common.transport.local import LocalNetwork
from recording.report.aggregator import Collector, RunAggregator, recorded_application
from recording.report.application import Figures, figures_of, format_truth
from recording.report.summary import describe

PICK_PLACE = find_application("pick_place")


@pytest.mark.parametrize(("values", "line"), [
    ({"placed": 3, "targets": 7, "state": "GRASPING", "target": "ball_4", "started": True},
     "3 of 7 placed - GRASPING ball_4"),
    ({"targets": 2}, "0 of 2 placed - IDLE (waits for `zencell task start`)"),
    ({"paused": True, "started": True}, "0 of 0 placed - IDLE (paused)"),
])
def test_progress_is_one_line(values, line):
    aggregator = RunAggregator("panda", PICK_PLACE)
    assert aggregator.progress == "no task status received yet"
    aggregator.on("pick_place_status", PickPlaceStatus.model_validate(values), 0.0, 0)
    assert aggregator.progress == line


def test_topics_are_those_of_the_application_which_is_found_by_its_status():
    assert {topic.key for topic in RunAggregator("panda", PICK_PLACE).topics} == {
        "pick_place_status", "validated_targets", "rejected_targets", "motion/status", "scene_objects", "scene_balls"}
    found = recorded_application(["joint_states", "outline_status"])
    assert found is not None and found.name == "outlining"
    assert {"outline_status", "contour_path"} <= {topic.key for topic in RunAggregator("ur5", found).topics}
    assert recorded_application(["joint_states"]) is None


class MoveStatus(m.TaskStatus):
    """Status of an application without a figures class."""


@pytest.fixture
def own(monkeypatch):
    module = ModuleType("my_pkg.move")
    status = Topic("move_status", MoveStatus, "state", "state")
    module.APPLICATION = Application(topics=ApplicationTopics(status=status))
    monkeypatch.setitem(sys.modules, "my_pkg", ModuleType("my_pkg"))
    monkeypatch.setitem(sys.modules, "my_pkg.move", module)
    return find_application("my_pkg.move")


def test_custom_application_has_a_default_summary(own):
    aggregator = RunAggregator("mine", own)
    assert figures_of(own) is Figures
    status = MoveStatus(state="LIFTING", done=0, total=1, subject="cube", started=True)
    aggregator.on("move_status", status, 1.0, 0)
    assert aggregator.progress == "0 of 1 done - LIFTING cube"
    aggregator.on(topics.MOTION_STATUS.key, m.MotionStatus(state="active"), 2.5, 0)
    done = MoveStatus(state="DONE", done=1, total=1, started=True, figures={"moved_m": 0.3})
    aggregator.on("move_status", done, 3.0, 0)
    figures = aggregator.summary.as_dict()
    assert (figures["state"], figures["placed"], figures["targets"]) == ("DONE", 1, 1)
    assert figures["figures"] == {"moved_m": 0.3} and figures["seconds"]["first_motion"] == 2.5
    assert describe(figures, aggregator.figures)[:2] == ["mine: DONE, 1 of 1 done", "  moved_m 0.3"]


def balls(*labels: str) -> m.PoseArray:
    return m.PoseArray(poses=[m.Pose()] * len(labels), labels=list(labels))


def test_truth_is_that_of_the_world_objects_and_names_several_containers():
    aggregator = RunAggregator("panda", PICK_PLACE)

    def truth(key: str, message: m.Message) -> object:
        aggregator.on(key, message, 0.0, 0)
        return aggregator.summary.as_dict()["truth"]

    empty = {"in_box": 0, "on_table": 0, "elsewhere": 0}
    assert truth("scene_objects", m.WorldObjects()) == {**empty, "containers": {}}
    assert truth("scene_balls", balls("box")) == {**empty, "in_box": 1, "containers": {"box": 1}}  # an old recording
    things = [m.WorldObject(id=f"cube_{k}", shape="box", state=state, container=container) for k, (state, container)
              in enumerate([("contained", "tray"), ("contained", "tray"), ("table", ""), ("held", "")])]
    assert truth("scene_objects", m.WorldObjects(objects=things)) == {
        "in_box": 2, "on_table": 1, "elsewhere": 1, "containers": {"tray": 2}}
    assert not aggregator.summary.truth.settled
    one_box = {**empty, "in_box": 3, "on_table": 1, "containers": {"box": 3}}
    assert format_truth(one_box) == "3 in the box, 1 on the table"
    assert format_truth({"in_box": 3, "on_table": 1, "elsewhere": 2, "containers": {"left": 1, "right": 2}}) == (
        "1 in left, 2 in right, 1 on the table, 2 elsewhere")


async def test_collector_feeds_the_aggregator_and_waits_for_falling_objects():
    net, clock = LocalNetwork(), Clock(2.0)
    cell = net.bus("cell", cell="test", clock=clock)
    aggregator = RunAggregator("test", PICK_PLACE, speed=2.0)
    progress: list[str] = []
    collector = Collector(net.bus("supervisor", cell="test", clock=clock), aggregator, 0.0, progress.append)
    collecting = asyncio.create_task(collector.run())
    truth = cell.writer(SCENE_BALLS)
    truth.put(balls("box", "falling"))
    rejection = m.Rejection(position=m.Vector3(x=0.9, z=0.03), reason="too far")
    cell.writer(REJECTED_TARGETS).put(m.Rejections(header=cell.header(), rejected=[rejection]))
    cell.writer(topics.MOTION_STATUS).put(m.MotionStatus(state="active"))
    stamp = clock.now_ns() - int(0.020 * 2.0 * 1e9)
    cell.writer(VALIDATED_TARGETS).put(m.PoseArray(header=m.Header(stamp=stamp)))
    done = PickPlaceStatus(header=cell.header(), state="DONE", started=True, done=2, total=2)
    cell.writer(PICK_PLACE_STATUS).put(done)
    async with asyncio.timeout(30):
        await collector.ended.wait()
        settling = asyncio.create_task(collector.settle())
        await asyncio.sleep(0)
        truth.put(balls("box", "box"))
        await settling
    collecting.cancel()
    figures = aggregator.summary.as_dict()
    assert figures["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0, "containers": {"box": 2}}
    assert figures["rejected"] == [{"position": [0.9, 0.0, 0.03], "reason": "too far"}]
    assert figures["seconds"]["first_motion"] is not None
    assert figures["frame_to_target_ms"]["p50"] >= 20
    assert progress == ["2 of 2 placed - DONE"]


def test_rates_come_from_reader_counts():
    rates = Rates()
    for service, key in (("left_camera", "left/image_raw"), ("trajectory_executor", "joint_states")):
        rates.update(m.ServiceCounters(service=service, writes=[key]), 0.0)
    for second in range(3):
        received = {"left/image_raw": 10 * second, "joint_states": 100 * second}
        rates.update(m.ServiceCounters(service="vision_detector", received=received), float(second))
    assert rates.busiest_of("left_camera") == ("left/image_raw", 10.0)
    assert rates.busiest_of("trajectory_executor") == ("joint_states", 100.0)
    assert rates.busiest_of("smart_pick_place") is None
    rates.update(m.ServiceCounters(service="vision_detector", received={"left/image_raw": 0}), 3.0)
    assert rates.of_topic("left/image_raw") == 0.0  # it was restarted


def test_most_recent_of_invented_services_are_remembered():
    rates = Rates()

    def count(second: int) -> None:
        viewer = m.ServiceCounters(service="viewer", writes=["a"], received={"a": 5 * second})
        rates.update(viewer, float(second))

    for second in range(3):
        for number in range(1000):
            made_up = {f"key {second} {number} {i}": second for i in range(10)}
            rates.update(m.ServiceCounters(service=f"{number}", received=made_up), float(second))
        count(second)
    assert len(rates._counted) == MOST_SERVICES >= len(rates._rates)
    assert sum(map(len, rates._rates.values())) <= 10 * MOST_SERVICES
    assert rates.counted("0") is None and rates.received_by("0") is None
    assert rates.busiest_of("viewer") is None  # it was pushed out each time
    for second in (3, 4):
        count(second)
    assert rates.busiest_of("viewer") == ("a", 5.0) and rates.received_by("viewer") == 5.0
