"""What `zencell top` shows: topics, services, their processes, and the clock of the cell."""

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
from common.messages import GripperState, Header, ServiceCounters, ServiceStatus, SupervisorStatus
from common.topics import Topic
from common.transport.local import LocalNetwork

CLOCK = Clock(2.0)


def monitored(network: LocalNetwork) -> CellMonitor:
    return CellMonitor(network.bus("top"), CLOCK)


def counted(service: str, received: dict[str, int], **more: dict[str, int]) -> ServiceCounters:
    return ServiceCounters(service=service, received=received, **more)


async def test_repeated_state_has_no_delay():
    network = LocalNetwork()
    gripper = network.bus("executor").writer(topics.GRIPPER_STATE)
    gripper.put(GripperState(header=Header(stamp=5), width=0.0))
    async with monitored(network) as monitor:
        gripper.raw.repeat()
        (row,) = monitor.view().topics
        assert (row.messages, row.p50) == (1, None)
        gripper.put(GripperState(header=Header(stamp=CLOCK.now_ns()), width=0.0))
        (row,) = monitor.view().topics
        assert row.messages == 2 and row.p50 is not None


async def test_topics_published_on_demand_are_not_subscribed_to():
    network = LocalNetwork()
    bus = network.bus("camera")
    writers = {key: bus.writer(topic) for key, topic in all_topics().items() if isinstance(topic, Topic)}
    async with monitored(network) as monitor:
        assert {key for key, writer in writers.items() if not writer.matched} == set(on_demand())
        monitor.count(counted("viewer", {"detection_image": 0}), 1.0)
        monitor.count(counted("viewer", {"detection_image": 10}), 2.0)
        rows = {row.topic: row for row in monitor.view().topics}
    assert (rows["detection_image"].hz, rows["detection_image"].bytes_per_second) == (10, None)


async def test_services_show_the_counters_of_their_transport():
    network = LocalNetwork()
    await network.bus("vision").ready()
    async with monitored(network) as monitor:
        monitor.count(counted("vision", {"camera/image_raw": 0}), 1.0)
        monitor.count(counted("vision", {"camera/image_raw": 20}, dropped={"a": 1, "b": 2}, invalid={"a": 4}), 3.0)
        (row,) = monitor.view().services
        assert (row.service, row.state, row.pid, row.cpu) == ("vision", "ready", None, None)
        assert (row.received, row.dropped, row.invalid, row.overflow) == (10.0, 3, 4, 0)
        monitor.count(counted("vision", {"camera/image_raw": 1}), 4.0)  # it was restarted
        assert monitor.view().services[0].received == 0


@pytest.mark.parametrize("other", ["param/mine", "my//key", "/key", "**", "a b", ""])
async def test_custom_key_is_subscribed_to_once_a_service_reads_it(other):
    network = LocalNetwork()
    writer = network.bus("mine").raw_writer("test/my/key", "", "event")
    async with monitored(network) as monitor:
        writer.put(b"lost")
        monitor.count(counted("mine", {other: 1, "my/key": 1}), 1.0)
        writer.put(b"received")
        (row,) = monitor.view().topics
    assert (row.topic, row.messages, row.p50) == ("my/key", 1, None)


async def test_number_of_invented_keys_is_limited():
    async with monitored(LocalNetwork()) as monitor:
        for number in range(10):
            monitor.count(counted(f"liar_{number}", {f"mine/{number}/{i}": 1 for i in range(200)}), 1.0)
        assert len(monitor._statistics) == MAX_KEYS
        assert monitor.view().topics == []


def test_state_of_a_service_follows_from_the_supervisor_and_its_token():
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


def test_load_is_that_of_the_named_process():
    processes = Processes()
    assert processes.load_of(os.getpid(), "no_such_service") == (None, None)
    assert processes.load_of(2**22 + 1, "anything") == (None, None)
    cpu, memory = processes.load_of(os.getpid(), "supervisor")
    assert cpu is not None and memory is not None and memory > 1


def test_table_and_json_have_each_service_and_topic():
    view = View("panda", 2.0, False, 3.0, [
        ServiceRow("vision", "restarting", 12, 34.56, 101.2, 2, 10.0, 5, 1, 0), ServiceRow("far", "ready"),
    ], [TopicRow("camera/image_raw", 10.0, 9.2e6, 123, 7.1, 12.0), TopicRow("detection_image", 9.9, *[None] * 4)])
    console = Console(file=io.StringIO(), width=110)
    console.print(render(view))
    lines = [line.split() for line in console.file.getvalue().splitlines()]
    assert ["vision", "restarting", "12", "34.6", "101", "2", "10.0", "5", "1", "0"] in lines
    assert ["far", "ready", "0"] in lines
    assert ["camera/image_raw", "10.00", "9200.0", "123", "7.1", "12.0"] in lines
    assert ["detection_image", "9.90"] in lines
    assert lines[0][:4] == ["panda", "at", "speed", "2;"]
    assert "the router is lost" in " ".join(lines[0])
    values = view.as_dict()
    assert (values["services"][0]["service"], values["speed"]) == ("vision", 2.0)


@pytest.mark.parametrize("values", [
    {"speed": 5e-324}, {"speed": 1e12}, {"speed": 10.0, "epoch": 1}, {"speed": 10.0, "epoch": 2**63 - 1},
    {"booted": -(2**63) + 1}, {"booted": 2**63 - 1},
])
async def test_tool_ignores_an_impossible_clock(values):
    network = LocalNetwork()
    status = SupervisorStatus.model_validate(
        {"cell": "cell", "host": socket.gethostname(), "services": [], "epoch": CLOCK.epoch_ns, **values})
    network.bus("liar").writer(topics.SUPERVISOR_STATUS).put(status)
    tool = network.bus("top", clock=CLOCK)
    assert await cell_clock(tool) is CLOCK
    assert tool.header().stamp > 0
