import io
import os
import socket

import pytest
from rich.console import Console

from cli.top import render
from common import topics
from common.application import all_topics
from common.client.joining import cell_clock
from common.client.monitor import MAX_KEYS, CellMonitor, Processes, ServiceRow, TopicRow, View, on_demand, statuses
from common.clock import Clock
from common.messages import (
    GripperState,
    Header,
    Image,
    ServiceCounters,
    ServiceStatus,
    SupervisorStatus,
)
from common.topics import Topic
from common.transport.local import LocalNetwork

CLOCK = Clock(2.0)


def counted(service: str, received: dict[str, int], **more: dict[str, int]) -> ServiceCounters:
    return ServiceCounters(service=service, received=received, **more)


def image(clock: Clock) -> Image:
    return Image(header=Header(stamp=clock.now_ns()), height=1, width=1, encoding="mono8", data=b"x")


async def test_topics_show_what_came_and_how_old_it_was() -> None:
    network = LocalNetwork()
    camera = network.bus("camera", clock=CLOCK).writer(topics.CAMERA_IMAGE)
    async with CellMonitor(network.bus("top"), CLOCK) as watch:
        for _ in range(3):
            camera.put(image(CLOCK))
        (row,) = watch.view().topics
    assert (row.topic, row.messages) == ("camera/image_raw", 3)
    assert row.p99 is not None
    assert row.p50 is not None
    assert 0 <= row.p50 <= row.p99


async def test_repetition_of_an_old_state_says_nothing_of_its_age() -> None:
    network = LocalNetwork()
    gripper = network.bus("executor").writer(topics.GRIPPER_STATE)
    gripper.put(GripperState(header=Header(stamp=5), width=0.0))
    async with CellMonitor(network.bus("top"), CLOCK) as watch:
        gripper.raw.repeat()
        (row,) = watch.view().topics
        assert (row.messages, row.p50) == (1, None)
        gripper.put(GripperState(header=Header(stamp=CLOCK.now_ns()), width=0.0))
        (row,) = watch.view().topics
        assert row.messages == 2
        assert row.p50 is not None


async def test_what_is_made_only_for_listeners_is_not_listened_to() -> None:
    network = LocalNetwork()
    bus = network.bus("camera")
    made = {key: bus.writer(topic) for key, topic in all_topics().items() if isinstance(topic, Topic)}
    async with CellMonitor(network.bus("top"), CLOCK) as watch:
        assert {key for key, writer in made.items() if not writer.matched} == set(on_demand())
        watch.count(counted("viewer", {"detection_image": 0}), 1.0)
        watch.count(counted("viewer", {"detection_image": 10}), 2.0)
        rows = {row.topic: row for row in watch.view().topics}
    assert rows["detection_image"].hz == 10
    assert rows["detection_image"].bytes_per_second is None


async def test_services_show_what_their_transport_counted() -> None:
    network = LocalNetwork()
    bus = network.bus("vision")
    await bus.ready()
    async with CellMonitor(network.bus("top"), CLOCK) as watch:
        watch.count(counted("vision", {"camera/image_raw": 0}), 1.0)
        watch.count(counted("vision", {"camera/image_raw": 20}, dropped={"a": 1, "b": 2}, invalid={"a": 4}), 3.0)
        (row,) = watch.view().services
        assert (row.service, row.state, row.pid, row.cpu) == ("vision", "ready", None, None)
        assert (row.received, row.dropped, row.invalid, row.overflow) == (10.0, 3, 4, 0)
        watch.count(counted("vision", {"camera/image_raw": 1}), 4.0)  # it was started again
        assert watch.view().services[0].received == 0


async def test_key_of_ones_own_is_listened_to_once_somebody_reads_it() -> None:
    network = LocalNetwork()
    writer = network.bus("mine").raw_writer("test/my/key", "", "event")
    async with CellMonitor(network.bus("top"), CLOCK) as watch:
        writer.put(b"lost")
        watch.count(counted("mine", {"my/key": 1, "param/mine": 2}), 1.0)
        writer.put(b"heard")
        (row,) = watch.view().topics
    assert (row.topic, row.messages, row.p50) == ("my/key", 1, None)


@pytest.mark.parametrize("key", ["my//key", "/key", "**", "a b", ""])
async def test_counts_of_what_is_no_key_are_no_end_of_what_others_count(key: str) -> None:
    network = LocalNetwork()
    async with CellMonitor(network.bus("top"), CLOCK) as watch:
        watch.count(counted("mine", {key: 1, "my/key": 1}), 1.0)
        network.bus("mine").raw_writer("test/my/key", "", "event").put(b"heard")
        assert [row.topic for row in watch.view().topics] == ["my/key"]


def test_processes_that_are_gone_are_stopped_and_those_of_other_hosts_are_ready() -> None:
    status = SupervisorStatus(cell="c", services=[
        ServiceStatus(name="router", state="ready", pid=1), ServiceStatus(name="a", state="ready", pid=2),
        ServiceStatus(name="b", state="restarting", restarts=3),
    ])
    up = {each.name: each.state for each in statuses(status, frozenset({"supervisor", "a", "far"}), True)}
    assert up == {"router": "ready", "a": "ready", "b": "restarting", "far": "ready", "supervisor": "ready"}
    gone = statuses(status, frozenset({"a"}), False)
    assert [(each.name, each.state, each.pid) for each in gone] == [
        ("router", "stopped", None), ("a", "ready", 2), ("b", "stopped", None)]
    assert [each.name for each in statuses(None, frozenset({"a"}), True)] == ["a"]


def test_load_is_of_the_process_that_has_the_name_and_of_no_other() -> None:
    processes = Processes()
    assert processes.load_of(os.getpid(), "no_such_service") == (None, None)
    assert processes.load_of(2**22 + 1, "anything") == (None, None)
    cpu, memory = processes.load_of(os.getpid(), "supervisor")
    assert cpu is not None
    assert memory is not None
    assert memory > 1


def test_table_has_a_line_for_each_service_and_topic() -> None:
    view = View("panda", 2.0, False, 3.0, [
        ServiceRow("vision", "restarting", 12, 34.56, 101.2, 2, 10.0, 5, 1, 0), ServiceRow("far", "ready"),
    ], [TopicRow("camera/image_raw", 10.0, 9.2e6, 123, 7.1, 12.0), TopicRow("detection_image", 9.9, *[None] * 4)])
    console = Console(file=io.StringIO(), width=110)
    console.print(render(view))
    lines = [line.split() for line in console.file.getvalue().splitlines()]  # type: ignore[attr-defined]
    assert ["vision", "restarting", "12", "34.6", "101", "2", "10.0", "5", "1", "0"] in lines
    assert ["far", "ready", "0"] in lines
    assert ["camera/image_raw", "10.00", "9200.0", "123", "7.1", "12.0"] in lines
    assert ["detection_image", "9.90"] in lines
    assert lines[0][:4] == ["panda", "at", "speed", "2;"]
    assert "the router is lost" in " ".join(lines[0])


def test_view_is_json() -> None:
    view = View("panda", 1.0, True, 0.0, [ServiceRow("a", "ready")], [])
    assert view.as_dict()["services"][0]["service"] == "a"
    assert pytest.approx(1.0) == view.as_dict()["speed"]


async def test_keys_that_somebody_makes_up_are_listened_to_up_to_a_number() -> None:
    network = LocalNetwork()
    async with CellMonitor(network.bus("top"), CLOCK) as watch:
        for number in range(10):
            watch.count(counted(f"liar_{number}", {f"mine/{number}/{i}": 1 for i in range(200)}), 1.0)
        assert len(watch._statistics) == MAX_KEYS
        assert len(watch.view().topics) == 0


@pytest.mark.parametrize("told", [
    {"speed": 5e-324}, {"speed": 1e12}, {"speed": 10.0, "epoch": 1}, {"speed": 10.0, "epoch": 2**63 - 1},
    {"booted": -(2**63) + 1}, {"booted": 2**63 - 1},
])
async def test_clock_that_there_cannot_be_is_not_that_of_a_tool(told: dict[str, float]) -> None:
    network = LocalNetwork()
    said = SupervisorStatus.model_validate(
        {"cell": "cell", "host": socket.gethostname(), "services": [], "epoch": CLOCK.epoch_ns, **told})
    network.bus("liar").writer(topics.SUPERVISOR_STATUS).put(said)
    tool = network.bus("top", clock=CLOCK)
    assert await cell_clock(tool) is CLOCK
    tool.clock = await cell_clock(tool)
    assert tool.header().stamp > 0
