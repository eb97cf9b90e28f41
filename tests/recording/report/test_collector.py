"""What a cell says on its topics arrives in the figures of the run."""

import asyncio

from applications.pick_place.topics import (
    PICK_PLACE_STATUS,
    REJECTED_TARGETS,
    SCENE_BALLS,
    VALIDATED_TARGETS,
    PickPlaceStatus,
)
from common import topics
from common.application import find_application
from common.client.statistics import MOST_SERVICES, Rates
from common.clock import Clock
from common.messages import (
    Header,
    MotionStatus,
    Pose,
    PoseArray,
    Rejection,
    Rejections,
    ServiceCounters,
    Vector3,
)
from common.transport.local import LocalNetwork
from recording.report.aggregator import Collector, RunAggregator


def test_rates_come_from_reader_counts() -> None:
    rates = Rates()
    for service, key in (("left_camera", "left/image_raw"), ("trajectory_executor", "joint_states")):
        rates.update(ServiceCounters(service=service, writes=[key]), 0.0)
    for second in range(3):
        received = {"left/image_raw": 10 * second, "joint_states": 100 * second}
        rates.update(ServiceCounters(service="vision_detector", received=received), float(second))
    assert rates.busiest_of("left_camera") == ("left/image_raw", 10.0)
    assert rates.busiest_of("trajectory_executor") == ("joint_states", 100.0)
    assert rates.busiest_of("smart_pick_place") is None
    rates.update(ServiceCounters(service="vision_detector", received={"left/image_raw": 0}), 3.0)
    assert rates.of_topic("left/image_raw") == 0.0  # it was started again


def test_of_invented_services_the_most_recent_are_remembered() -> None:
    rates = Rates()
    for second in range(3):
        for number in range(1000):
            made_up = {f"key {second} {number} {i}": second for i in range(10)}
            rates.update(ServiceCounters(service=f"{number}", received=made_up), float(second))
        rates.update(ServiceCounters(service="viewer", writes=["a"], received={"a": 5 * second}), float(second))
    assert len(rates._counted) == MOST_SERVICES >= len(rates._rates)
    assert sum(map(len, rates._rates.values())) <= 10 * MOST_SERVICES
    assert rates.counted("0") is None and rates.received_by("0") is None
    assert rates.busiest_of("viewer") is None  # it was pushed out each time
    for second in (3, 4):
        rates.update(ServiceCounters(service="viewer", writes=["a"], received={"a": 5 * second}), float(second))
    assert rates.busiest_of("viewer") == ("a", 5.0) and rates.received_by("viewer") == 5.0


def balls(*labels: str) -> PoseArray:
    return PoseArray(poses=[Pose()] * len(labels), labels=list(labels))


async def test_collector_feeds_the_aggregator_and_waits_for_falling_objects() -> None:
    net = LocalNetwork()
    clock = Clock(2.0)
    cell = net.bus("cell", cell="test", clock=clock)
    fold = RunAggregator("test", find_application("pick_place"), speed=2.0)
    progress: list[str] = []
    collector = Collector(net.bus("supervisor", cell="test", clock=clock), fold, 0.0, progress.append)
    listening = asyncio.create_task(collector.run())
    truth = cell.writer(SCENE_BALLS)
    truth.put(balls("box", "falling"))
    rejection = Rejection(position=Vector3(x=0.9, z=0.03), reason="too far")
    cell.writer(REJECTED_TARGETS).put(Rejections(header=cell.header(), rejected=[rejection]))
    cell.writer(topics.MOTION_STATUS).put(MotionStatus(state="active"))
    stamp = clock.now_ns() - int(0.020 * 2.0 * 1e9)
    cell.writer(VALIDATED_TARGETS).put(PoseArray(header=Header(stamp=stamp)))
    done = PickPlaceStatus(header=cell.header(), state="DONE", started=True, done=2, total=2)
    cell.writer(PICK_PLACE_STATUS).put(done)
    async with asyncio.timeout(30):
        await collector.ended.wait()
        settling = asyncio.create_task(collector.settle())
        await asyncio.sleep(0)
        truth.put(balls("box", "box"))
        await settling
    listening.cancel()
    figures = fold.summary.as_dict()
    assert figures["truth"] == {"in_box": 2, "on_table": 0, "elsewhere": 0, "containers": {"box": 2}}
    assert figures["rejected"] == [{"position": [0.9, 0.0, 0.03], "reason": "too far"}]
    assert figures["seconds"]["first_motion"] is not None
    assert figures["frame_to_target_ms"]["p50"] >= 20
    assert progress == ["2 of 2 placed - DONE"]
