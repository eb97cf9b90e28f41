"""Attacks on a secured cell with its page: without a certificate, with a wrong one, and with one of its services.

Each test also shows that a permitted client succeeds with what the attacker is denied.
"""

from __future__ import annotations

import asyncio
import base64
import json
import re
import socket
import subprocess
import urllib.error
import urllib.request
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import psutil
import pytest
import zenoh

from applications.pick_place.topics import DETECTED_OBJECTS
from common import messages as m
from common import topics
from common.errors import NoRouter
from common.topics import of_service
from common.transport.codec import DEFAULT_LIMIT, decode, decode_attachment, encode
from common.transport.credentials import ROUTER_NAME, Credentials, credentials_of
from common.transport.endpoint import MAX_BYTES, MAX_OTHER_BYTES, client_config, router_config
from common.transport.session import RawSample
from common.transport.zenoh_session import connect
from recording.reader import Recording
from security.certificates import Authority
from security.page_tokens import ROLES, read_tokens
from tests.harness import RunningCell, command_line, environment, until
from tests.security.raw_client import REFUSAL_MS, RawClient, Received
from zencell.blocking import Cell

pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(300)]

TOKEN = "the-token-of-this-page-0123456789"
TRUTH = {"panda/scene_balls", "panda/scene_objects"}
MARK = b"attack"
SERVICES = 9
# A process that ends was then ended by an attack.
NO_WATCHDOGS = ("--set", "watchdogs.silence=0", "--set", "watchdogs.loop=0")


@dataclass
class Secured:
    """A running cell, and the folder of its certificates."""

    cell: RunningCell
    folder: Path
    page: int
    recording: Path

    def client(self, name: str) -> RawClient:
        """Return a client with the certificate of that common name."""
        return RawClient(self.cell.endpoint, credentials_of(name, self.folder))

    @property
    def environment(self) -> dict[str, str]:
        return {**environment(), "ZENCELL_SECURE": str(self.folder), "ZENCELL_DOMAIN": str(self.cell.domain)}

    def tool(self, *arguments: str, **variables: str) -> subprocess.CompletedProcess[str]:
        """Run a zencell command with the certificates and further environment variables."""
        return subprocess.run(
            command_line(*arguments), env={**self.environment, **variables}, cwd=self.cell.folder, capture_output=True,
            text=True, timeout=60, check=False,
        )


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


@pytest.fixture(scope="module")
def secured(certificates: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    """A cell at speed 1 whose task waits, recorded from its start on."""
    folder, page = tmp_path_factory.mktemp("secured_cell"), free_port()
    recording = folder / "all.mcap"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZENCELL_SECURE", str(certificates))  # for the listeners in this process
        with RunningCell(
            folder, "up", "panda", "--secure", str(certificates), "--set", "autostart=false", *NO_WATCHDOGS,
            "--viewer-port", str(page), "--record", str(recording), secrets={"ZENCELL_VIEWER_TOKEN": TOKEN},
        ) as cell:

            async def ready() -> None:
                async with connect(cell="panda", service="watcher", endpoint=cell.endpoint, timeout=120) as bus:
                    await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready, timeout=120)

            try:
                asyncio.run(ready())
            except (TimeoutError, NoRouter):
                pytest.fail(f"the cell did not start:\n{cell.tail()}")
            yield Secured(cell, certificates, page, recording)


def all_ready(status: m.SupervisorStatus) -> bool:
    return len(status.services) > SERVICES and all(service.state == "ready" for service in status.services)


@pytest.fixture
def same_processes(secured: Secured) -> Iterator[None]:
    """Check after the test that no process has ended or restarted."""
    before = {name: process.pid for name, process in secured.cell.processes().items()}
    yield
    assert {name: process.pid for name, process in secured.cell.processes().items()} == before
    with secured.client("operator") as operator:
        assert len(operator.tokens("panda/alive/*")) >= SERVICES


@pytest.mark.usefixtures("same_processes")
def test_program_with_the_operators_certificate_may_do_what_the_camera_may_not(
    secured: Secured, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ZENCELL_SECURE", raising=False)
    edit = m.SceneEdit(op="add", id="post", shape="sphere", dimensions=[0.05],
                       pose=m.Pose(position=m.Vector3(x=-0.5, z=0.5)))
    with (secured.client("panda.camera_simulator") as camera,
          Cell(domain=secured.cell.domain, secure=str(secured.folder), owner="anna") as cell):
        assert cell.name == "panda" and cell.arm.move("home").state == "succeeded"
        assert camera.query("panda/scene/edit", encode(edit), timeout=1.0) == []
        assert cell.scene.objects() == []
        assert cell.call("scene/edit", edit).ids == ["added/post"]
        assert [solid.id for solid in cell.scene.objects()] == ["added/post"] and cell.scene.remove("post") == []


# --- no certificate, or a wrong one -----------------------------------------------------------------------------------


def test_client_without_a_certificate_cannot_connect(secured: Secured) -> None:
    open_endpoint = secured.cell.endpoint.replace("tls/", "tcp/")
    with pytest.raises(zenoh.ZError):
        RawClient(open_endpoint, None, connect_ms=REFUSAL_MS)
    bare = client_config(secured.cell.endpoint, connect_ms=REFUSAL_MS)
    bare.insert_json5("transport/link/tls", json.dumps({
        "root_ca_certificate": str(secured.folder / "ca.pem"), "verify_name_on_connect": True,
    }))
    with pytest.raises(zenoh.ZError):
        zenoh.open(bare)
    with secured.client("panda.camera_simulator") as camera:
        assert camera.connected


@pytest.mark.parametrize("fault", ["foreign authority", "expired", "public certificate without its key"])
def test_invalid_certificate_cannot_connect(secured: Secured, tmp_path: Path, fault: str) -> None:
    own = Authority.load(secured.folder / "ca.pem", secured.folder / "ca.key")
    signer = Authority.new(10) if fault != "expired" else own
    made = Credentials(secured.folder / "ca.pem", tmp_path / "operator.pem", tmp_path / "operator.key")
    signer.issue("operator", [], -1 if fault == "expired" else 10, made.certificate, made.key)
    if fault == "public certificate without its key":
        made = Credentials(made.authority, secured.folder / "operator.pem", made.key)
    with pytest.raises(zenoh.ZError):
        RawClient(secured.cell.endpoint, made, connect_ms=REFUSAL_MS)
    own.issue("operator", [], 10, tmp_path / "good.pem", tmp_path / "good.key")
    good = Credentials(made.authority, tmp_path / "good.pem", tmp_path / "good.key")
    with RawClient(secured.cell.endpoint, good) as one:
        assert one.query("panda/motion/status")


@pytest.mark.parametrize("impostor", ["foreign router", "a service of the cell"])
def test_client_connects_to_no_false_router(secured: Secured, tmp_path: Path, impostor: str) -> None:
    if impostor == "foreign router":
        Authority.new(10).issue(ROUTER_NAME, ["127.0.0.1"], 10, tmp_path / "router.pem", tmp_path / "router.key")
        false = Credentials(secured.folder / "ca.pem", tmp_path / "router.pem", tmp_path / "router.key")
    else:
        false = credentials_of("panda.camera_simulator", secured.folder)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    task = credentials_of("panda.smart_pick_place", secured.folder)
    with zenoh.open(router_config([endpoint], false)), pytest.raises(zenoh.ZError):
        RawClient(endpoint, task, connect_ms=REFUSAL_MS)
    true = credentials_of(ROUTER_NAME, secured.folder)
    with zenoh.open(router_config([endpoint], true)), RawClient(endpoint, task) as client:
        assert client.connected


# --- a service's certificate, used for what the service does not do ---------------------------------------------------


def test_camera_cannot_command(secured: Secured) -> None:
    grip = encode(m.GripperCommand(id="by the camera", width=0.03))
    still = encode(m.ExecuteRequest(id="by the camera", trajectory=m.JointTrajectory(
        joint_names=["no_such_joint"], points=[
            m.JointTrajectoryPoint(time_from_start=t, positions=[0.0], velocities=[0.0], accelerations=[0.0])
            for t in (0.0, 1.0)
        ])))
    edit = encode(m.WorldEdit(op="reset"))
    commands = {"motion/execute": still, "motion/stop": encode(m.StopRequest()), "gripper/command": grip,
                "world/edit": edit, "task/command": encode(m.TaskCommand(command="start")),
                "motion/hold": encode(m.HoldRequest(hold=True)), "param/vision_detector": encode(m.ParameterRequest())}
    with (secured.client("panda.camera_simulator") as camera, secured.client("panda.smart_pick_place") as task,
          secured.client("operator") as operator):
        before = _received(operator)
        received = operator.subscribe("panda/**")
        received.wait_for("panda/joint_states")
        for key, payload in commands.items():
            assert camera.query(f"panda/{key}", payload, timeout=1.0) == []
            camera.put(f"panda/{key}", payload)
        for key in ("gripper/state", "motion/status", "planning_scene", "detected_objects", "joint_states"):
            camera.put(f"panda/{key}", MARK)
            camera.delete(f"panda/{key}")
        assert camera.query("panda/**", grip, timeout=1.0) == []
        camera.put("panda/camera/camera_info", MARK)  # permitted, and behind all earlier messages
        received.wait_for("panda/camera/camera_info", MARK)
        assert [key for key, payload in received.samples if payload == MARK] == ["panda/camera/camera_info"]
        assert received.keys.isdisjoint(f"panda/{key}" for key in commands)
        counted = _received(operator)
        assert [key for key in commands if counted.get(key) != before.get(key)] == []
        gripper = decode(m.GripperState, operator.query("panda/gripper/state")[0])
        assert gripper.id != "by the camera"
        assert "autostart" not in secured.cell.tail()
        (answer,) = task.query("panda/gripper/command", encode(m.GripperCommand(id="by the task", width=0.05)))
        assert decode(m.GripperState, answer).id == "by the task"
        (answer,) = task.query("panda/motion/execute", still)
        assert decode(m.MotionStatus, answer).state == "rejected"  # by the executor: it received it
        (answer,) = operator.query("panda/world/edit", edit)
        assert len(decode(m.WorldEditReply, answer).ids) == 7


def _received(operator: RawClient) -> dict[str, int]:
    """Return how many messages the executor has received, by key."""
    counters = operator.subscribe("panda/counters/*")
    counters.wait(lambda samples: any(one.service == "trajectory_executor" for one in _counters(samples)))
    return [one for one in _counters(counters.samples) if one.service == "trajectory_executor"][-1].received


def _counters(samples: list[tuple[str, bytes]]) -> list[m.ServiceCounters]:
    return [decode(m.ServiceCounters, payload) for _, payload in samples]


def test_detector_cannot_read_the_ground_truth(secured: Secured) -> None:
    with secured.client("panda.vision_detector") as detector, secured.client("panda.camera_simulator") as camera:
        stolen = detector.subscribe(*TRUTH, "panda/scene_$*", "panda/*", "panda/**", "**")
        images = detector.subscribe("panda/camera/image_raw")
        seen = camera.subscribe("panda/scene_objects")
        seen.wait(lambda samples: len(samples) > 1)  # a state is repeated each second
        images.wait_for("panda/camera/image_raw")
        for key in ("panda/scene_balls", "panda/scene_objects", "panda/scene_$*", "panda/**", "**"):
            answers = detector.query(key, timeout=1.0)
            assert not any(b"ball_" in answer for answer in answers)
            assert key in {"panda/**", "**"} or answers == []
        (truth,) = camera.query("panda/scene_objects")
        assert len(decode(m.WorldObjects, truth).objects) == 7
        assert stolen.keys.isdisjoint(TRUTH)
        assert detector.query("panda/camera/camera_info")


def test_service_cannot_impersonate_another(secured: Secured) -> None:
    with (secured.client("panda.camera_simulator") as camera, secured.client("operator") as operator,
          secured.client("ur5.contour_detector") as detector):
        there = operator.watch_tokens("*/alive/*")
        served = operator.watch_tokens("*/serves/**")
        for name in ("evil", "camera_opencv"):
            camera.declare_token(f"panda/alive/{name}")
        camera.declare_token("ur5/alive/contour_detector")
        camera.declare_token("panda/serves/motion/plan/camera_simulator")
        asked = camera.serve("panda/motion/plan", MARK)
        camera.serve("panda/gripper/state", MARK)
        camera.serve("panda/**", MARK)
        camera.put("panda/camera/camera_info", MARK)
        operator.query("panda/camera/camera_info")
        assert {"panda/alive/evil", "ur5/alive/contour_detector"}.isdisjoint(operator.tokens("*/alive/*"))
        assert MARK not in operator.query("panda/gripper/state")
        assert MARK not in operator.query("panda/motion/plan", b"\x80")
        assert asked.samples == []
        detector.declare_token("ur5/alive/contour_detector")
        detector.declare_token("ur5/serves/outline/select/contour_detector")
        detector.serve("ur5/outline/select", MARK)
        there.wait_for("ur5/alive/contour_detector")
        served.wait_for("ur5/serves/outline/select/contour_detector")
        assert operator.query("ur5/outline/select", b"\x80") == [MARK]
        assert {"panda/alive/evil", "panda/alive/camera_opencv"}.isdisjoint(there.keys)
        assert "panda/serves/motion/plan/camera_simulator" not in served.keys


async def test_second_executor_with_the_same_certificate_is_refused_and_both_report_it(
    secured: Secured, tmp_path: Path
) -> None:
    writers = set()

    def note_writer(sample: RawSample) -> None:
        attachment = decode_attachment(sample.attachment)
        assert attachment is not None
        writers.add(attachment.writer)

    async with connect(cell="panda", service="watcher", endpoint=secured.cell.endpoint, timeout=120) as bus:
        bus.raw_subscriber("panda/joint_states", note_writer)
        log = bus.reader(of_service(topics.LOG, "trajectory_executor"))
        second = asyncio.create_task(asyncio.to_thread(  # its own state folder: only the name conflicts
            secured.tool, "service", "trajectory_executor", "--cell", "panda", ZENCELL_STATE=str(tmp_path)))
        reported = await until(log, lambda line: "another trajectory_executor" in line.message, 120)
        refused = await second
    assert re.search(r"another trajectory_executor \(process \w+\) claims \S+ too and gives way: this one was there "
                     r"first", reported.message)
    assert refused.returncode == 2
    assert re.search(r"services\.trajectory_executor: another trajectory_executor is up, which has \S+ already: end it "
                     r"first, or start one$", refused.stderr.strip()), refused.stderr
    assert len(writers) == 1


@pytest.mark.parametrize("name", ["ur5.motion_planner", "ur5.supervisor"])
def test_service_of_one_cell_cannot_read_another(secured: Secured, name: str) -> None:
    with secured.client(name) as stranger, secured.client("panda.motion_planner") as planner:
        stolen = stranger.subscribe("panda/joint_states", "panda/**", "**", "*/joint_states")
        own = planner.subscribe("panda/joint_states")
        own.wait(lambda samples: len(samples) > 10)
        assert stolen.samples == []
        assert stranger.tokens("panda/alive/*") == []
        for key in ("panda/planning_scene", "panda/motion/plan", "panda/motion/status"):
            assert stranger.query(key, timeout=1.0) == []
        assert planner.query("panda/planning_scene")


def test_observer_reads_everything_and_commands_nothing(secured: Secured) -> None:
    with secured.client("observer") as observer, secured.client("operator") as operator:
        received = observer.subscribe("panda/**")
        received.wait(lambda samples: {"panda/scene_balls", "panda/joint_states"} <= {key for key, _ in samples})
        assert observer.query("panda/motion/status")
        stop = encode(m.StopRequest())
        for key in ("panda/motion/stop", "panda/motion/*", "panda/**"):
            assert observer.query(key, stop, timeout=1.0) == []
        assert operator.query("panda/motion/stop", stop)
        release = encode(m.HoldRequest(hold=False, stops=True))
        assert operator.query("panda/motion/hold", release)  # for the tests after it


@pytest.mark.usefixtures("same_processes")
def test_counters_in_the_name_of_another_service_are_refused(secured: Secured) -> None:
    forged = encode(m.ServiceCounters(service="vision_detector", received={"by the camera": 1}))
    with secured.client("panda.camera_simulator") as camera, secured.client("operator") as operator:
        counters = operator.subscribe("panda/counters/**")
        counters.wait_for("panda/counters/vision_detector")

        def refused(samples: list[tuple[str, bytes]]) -> bool:
            # Only the last one is permitted.
            for key in ("counters/vision_detector", "counters", "counters/camera_simulator"):
                camera.put(f"panda/{key}", forged)
            return any(one.service == "supervisor" and one.invalid.get(topics.COUNTERS.key)
                       for one in _counters(samples))

        counters.wait(refused)
        assert {key for key, payload in counters.samples if payload == forged} == {"panda/counters/camera_simulator"}


def test_plain_counters_hold_only_what_the_supervisor_copies(secured: Secured) -> None:
    forged = encode(m.ServiceCounters(service="vision_detector", received={"by the camera": 1}))
    with secured.client("panda.camera_simulator") as camera, secured.client("operator") as operator:
        plain = operator.subscribe("panda/counters")
        for _ in range(10):
            camera.put("panda/counters", forged)
        both = {"vision_detector", "camera_simulator"}
        plain.wait(lambda samples: both <= {one.service for one in _counters(samples)})
        assert forged not in [payload for _, payload in plain.samples]


# --- permitted messages that could do harm ---------------------------------------------------------------------------


@pytest.mark.usefixtures("same_processes")
def test_flood_does_not_starve_others(secured: Secured) -> None:
    with (secured.client("panda.camera_simulator") as camera, secured.client("operator") as operator,
          secured.client("panda.motion_planner") as planner):
        joints = planner.subscribe("panda/joint_states")
        joints.wait_for("panda/joint_states")
        answered = 0
        for _ in range(20):
            for _ in range(1000):
                camera.put("panda/log/camera_simulator", MARK)
                camera.put("panda/camera/image_raw", bytes(100))
            before = len(joints.samples)
            answered += len(operator.query("panda/motion/status", timeout=20.0))
            joints.wait(lambda samples, seen=before: len(samples) > seen)  # type: ignore[misc]
        assert answered == 20


async def test_malformed_messages_are_counted_and_do_no_harm(secured: Secured, same_processes: None) -> None:
    good = encode(m.Image(header=m.Header(), height=1, width=1, encoding="bgr8", data=bytes(3)))
    oversized = encode(m.Image(header=m.Header(), height=1, width=1, encoding="bgr8", data=bytes(3)).model_copy(
        update={"height": 2**31, "width": 2**31}))
    bad = [b"", MARK, b"\xc1", good[:-2], good + b"\0", oversized, b"\xdf\xff\xff\xff\xff", b"\x91" * 5000,
           bytes(DEFAULT_LIMIT + 1)]
    name = topics.CAMERA_IMAGE.key

    def refused(counters: m.ServiceCounters) -> bool:
        return counters.service == "vision_detector" and counters.invalid.get(name, 0) >= before + len(bad) + 1

    with secured.client("panda.camera_simulator") as camera:
        async with secured.cell.listen() as bus:
            counters = bus.reader(topics.COUNTERS)
            first = await until(counters, lambda one: one.service == "vision_detector")
            before = first.invalid.get(name, 0)
            camera.put(f"panda/{name}", good, attachment=b"\xc1 not ours")
            for payload in bad:
                camera.put(f"panda/{name}", payload)
                await asyncio.sleep(0.3)  # a reader of a stream has only the newest of a sender
            while not refused(await until(counters, lambda one: one.service == "vision_detector")):
                camera.put(f"panda/{name}", MARK)
            found = bus.reader(DETECTED_OBJECTS)
            assert await found.next()  # from the real images


@pytest.mark.usefixtures("same_processes")
def test_router_drops_messages_that_are_too_large_for_their_topic(secured: Secured) -> None:
    with (secured.client("panda.camera_simulator") as camera, secured.client("panda.vision_detector") as detector,
          secured.client("panda.scene_manager") as other):
        received = detector.subscribe("panda/camera/camera_info", "panda/camera/image_raw")
        own = other.subscribe("panda/camera/camera_info")
        camera.put("panda/camera/camera_info", bytes(MAX_OTHER_BYTES + 1))
        camera.put("panda/camera/camera_info", MARK)
        received.wait_for("panda/camera/camera_info", MARK)
        camera.put("panda/camera/image_raw", bytes(MAX_BYTES + 1))  # the router closes the camera's link
        _wait_reconnected(camera, received)
        assert max(len(payload) for _, payload in received.samples) < MAX_OTHER_BYTES
        assert other.connected
        assert own.keys


def _wait_reconnected(camera: RawClient, received: Received) -> None:
    """Return when messages of the camera arrive again."""
    before, again = len(received.samples), ("panda/camera/camera_info", b"again")
    for _ in range(200):
        camera.put("panda/camera/camera_info", b"again")
        try:
            with received._changed:
                if received._changed.wait_for(lambda: again in received.samples[before:], 0.1):
                    return
        except zenoh.ZError:
            continue
    raise AssertionError("no message of the camera arrived after its link had been closed")


async def test_repeated_command_moves_nothing(secured: Secured) -> None:
    def call(key: str, message: m.Message) -> bytes:
        (answer,) = task.query(f"panda/{key}", encode(message), timeout=10.0)
        return answer

    with secured.client("panda.smart_pick_place") as task:
        async with connect(cell="panda", service="watcher", endpoint=secured.cell.endpoint, timeout=10) as bus:
            gripper, motion = bus.reader(topics.GRIPPER_STATE), bus.reader(topics.MOTION_STATUS)
            for identity, width in (("first", 0.02), ("second", 0.06)):
                command = m.GripperCommand(id=identity, width=width)
                await asyncio.to_thread(call, "gripper/command", command)
                await until(gripper, lambda state, sent=identity: state.id == sent and state.state == "succeeded")
            replayed = await asyncio.to_thread(call, "gripper/command", m.GripperCommand(id="first", width=0.02))
            assert decode(m.GripperState, replayed).id == "first"
            scenes = bus.reader(topics.PLANNING_SCENE)
            assert scenes.latest or await scenes.next()
            joints = bus.reader(topics.JOINT_STATES)
            begin = await joints.next()
            there = [q + 0.3 if index == 0 else q for index, q in enumerate(begin.position[:7])]
            goal = m.PlanRequest(id="plan", stage="replay", goal=m.JointGoal(positions=there), planning_time=5.0)
            plan = decode(m.PlanResponse, await asyncio.to_thread(call, "motion/plan", goal))
            assert plan.trajectory is not None, plan.message
            captured = m.ExecuteRequest(header=bus.header(), id="captured", trajectory=plan.trajectory)
            await asyncio.to_thread(call, "motion/execute", captured)
            await until(motion, lambda status: status.id == "captured" and status.state == "succeeded")
            again = decode(m.MotionStatus, await asyncio.to_thread(call, "motion/execute", captured))
            assert (again.id, again.state) == ("captured", "succeeded")
            long_ago = m.Header(stamp=captured.header.stamp - 10_000_000_000)
            for header, error in ((long_ago, "stale_request"), (bus.header(), "start_mismatch")):
                renamed = captured.model_copy(update={"id": f"renamed {error}", "header": header})
                refused = decode(m.MotionStatus, await asyncio.to_thread(call, "motion/execute", renamed))
                assert (refused.state, refused.error) == ("rejected", error)
            assert motion.latest is not None
            assert motion.latest.state != "active"
            end = await joints.next()
            assert end.position[0] == pytest.approx(there[0], abs=0.01)
            (state,) = await asyncio.to_thread(task.query, "panda/gripper/state")
            assert decode(m.GripperState, state).width == pytest.approx(0.06, abs=0.002)


# --- the page, the machine, the tools, and recorded files ---------------------------------------------


def test_page_requires_its_token(secured: Secured) -> None:
    address = f"http://127.0.0.1:{secured.page}/"
    for given in ("", "?token=", "?token=guessed-guessed-guessed"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(address + given, timeout=30)
        assert refused.value.code == 401
        refused.value.close()
    with urllib.request.urlopen(f"{address}?token={TOKEN}", timeout=30) as answer:
        assert answer.status == 200


def test_only_router_and_page_listen_and_only_on_the_loopback_address(secured: Secured) -> None:
    listening, datagrams = set(), []
    processes = {**secured.cell.processes(), "supervisor": psutil.Process(secured.cell.process.pid)}
    for name, process in processes.items():
        for found in process.net_connections("all"):
            if found.type == socket.SOCK_DGRAM and found.family in (socket.AF_INET, socket.AF_INET6):
                datagrams.append((name, found.laddr))
            elif found.status == psutil.CONN_LISTEN:
                listening.add((name, found.laddr.ip, found.laddr.port))
    port = int(secured.cell.endpoint.rpartition(":")[2])
    shown = {("router", "127.0.0.1", port), ("viewer", "127.0.0.1", secured.page)}
    inner = listening - shown  # where the TLS gate forwards to, and the listener for services of this host
    assert [(name, address) for name, address, _ in inner] == [("router", "127.0.0.1")] * 2
    assert listening > shown
    assert datagrams == []


def test_services_of_the_supervisor_bypass_the_tls_gate(secured: Secured) -> None:
    processes = {**secured.cell.processes(), "supervisor": psutil.Process(secured.cell.process.pid)}
    router = processes.pop("router")
    gate = int(secured.cell.endpoint.rpartition(":")[2])
    listening = {each.laddr.port for each in router.net_connections("tcp") if each.status == psutil.CONN_LISTEN}
    for name, process in processes.items():
        ports = [each.raddr.port for each in process.net_connections("tcp")
                if each.status == psutil.CONN_ESTABLISHED and each.raddr.port in listening]
        assert ports and gate not in ports, name


def test_tools_present_the_operators_certificate(secured: Secured) -> None:
    assert "trajectory_executor" in secured.tool("node", "list").stdout
    values = secured.tool("param", "get", "services.vision_detector.min_contour_area_px")
    assert values.returncode == 0, values.stderr
    echoed = secured.tool("topic", "echo", "joint_states", "-n", "1")
    assert "panda_joint1" in echoed.stdout, echoed.stderr
    refused = secured.tool("topic", "pub", "joint_states", "{}", "--once")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "only a cell's own services publish" in refused.stderr


def test_recording_needs_only_the_observers_certificate(secured: Secured, tmp_path: Path) -> None:
    only = tmp_path / "only"
    only.mkdir()
    for name in ("ca.pem", "observer.pem", "observer.key"):
        (only / name).write_bytes((secured.folder / name).read_bytes())
    (only / "observer.key").chmod(0o600)
    file = tmp_path / "seen.mcap"
    made = subprocess.run(
        command_line("record", "--duration", "3", "-o", str(file)), capture_output=True, text=True, timeout=60,
        env={**secured.environment, "ZENCELL_SECURE": str(only)}, check=False,
    )
    assert made.returncode == 0, made.stderr
    with Recording(file) as recording:
        assert {"panda/joint_states", "panda/motion/status", "panda/scene_objects"} <= {
            sample.key for sample in recording.samples()}


def test_no_secret_is_in_files_output_or_command_lines_of_a_cell(secured: Secured) -> None:
    """The last test of this file: it ends the cell."""
    listed = secured.tool("param", "list")
    assert "services.viewer.token" not in listed.stdout or TOKEN not in listed.stdout
    secured.cell.interrupt()
    asyncio.run(secured.cell.ended(60))
    secrets = [TOKEN.encode()]
    for key in secured.folder.glob("*.key"):
        lines = key.read_text().splitlines()
        secrets += [line.encode() for line in lines[1:-1]] + [base64.b64decode("".join(lines[1:-1]))]
        assert key.stat().st_mode & 0o777 == 0o600
    assert read_tokens(secured.folder, "panda").keys() == set(ROLES)
    assert len(secrets) > 50
    with Recording(secured.recording) as recording:
        written = [sample.payload for sample in recording.samples()]
    files = [path for path in secured.cell.folder.rglob("*") if path.is_file()]
    assert len(files) >= 3
    written += [path.read_bytes() for path in files]
    written += [listed.stdout.encode(), listed.stderr.encode()]
    for secret in secrets:
        assert not any(secret in text for text in written)
    for process in psutil.process_iter(["cmdline"]):
        assert TOKEN not in " ".join(process.info["cmdline"] or [])
