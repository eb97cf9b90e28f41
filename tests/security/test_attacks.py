"""Attacks on a secured cell with its page: without a certificate, with a wrong one, and with one of its services.

Each test also shows that a permitted client succeeds with what the attacker is denied.
"""

import asyncio
import base64
import json
import re
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
import zenoh

from common import messages as m
from common import topics
from common.topics import of_service
from common.transport.codec import decode, decode_attachment, encode
from common.transport.credentials import ROUTER_NAME, Credentials, credentials_of
from common.transport.endpoint import MAX_BYTES, MAX_OTHER_BYTES, client_config, router_config
from common.transport.session import RawSample
from common.transport.zenoh_session import connect
from recording.reader import Recording
from security.certificates import Authority
from security.page_tokens import ROLES, read_tokens
from tests.domains import free_port
from tests.harness import until
from tests.security.raw_client import REFUSAL_MS, RawClient, Received, issue
from tests.security.secured_cell import SERVICES, TOKEN, Secured, running_secured, sockets_of
from zencell.blocking import Cell

pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(300)]

TRUTH = {"panda/scene_balls", "panda/scene_objects"}
MARK = b"attack"
IMAGE = 500_000  # [bytes] pixels only


@pytest.fixture(scope="module")
def secured(certificates: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Secured]:
    with running_secured(certificates, tmp_path_factory.mktemp("secured_cell")) as running:
        yield running


@pytest.fixture
def same_processes(secured: Secured) -> Iterator[None]:
    """Check after the test that no process has ended or restarted."""
    before = {name: process.pid for name, process in secured.processes.items()}
    yield
    assert {name: process.pid for name, process in secured.processes.items()} == before
    with secured.client("operator") as operator:
        assert len(operator.tokens("panda/alive/*")) >= SERVICES


@pytest.mark.usefixtures("same_processes")
def test_program_with_the_operators_certificate_may_do_what_the_camera_may_not(secured: Secured, monkeypatch) -> None:
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
    with pytest.raises(zenoh.ZError):
        RawClient(secured.cell.endpoint.replace("tls/", "tcp/"), None, connect_ms=REFUSAL_MS)
    bare = client_config(secured.cell.endpoint, connect_ms=REFUSAL_MS)
    bare.insert_json5("transport/link/tls", json.dumps({
        "root_ca_certificate": str(secured.folder / "ca.pem"), "verify_name_on_connect": True,
    }))
    with pytest.raises(zenoh.ZError):
        zenoh.open(bare)
    with secured.client("panda.camera_simulator") as camera:
        assert camera.connected


def test_invalid_certificate_cannot_connect(secured: Secured, tmp_path: Path) -> None:
    own = Authority.load(secured.folder / "ca.pem", secured.folder / "ca.key")
    (tmp_path / "ca.pem").write_bytes((secured.folder / "ca.pem").read_bytes())
    foreign = issue(Authority.new(10), "operator", tmp_path, file="foreign")
    expired = issue(own, "operator", tmp_path, -1, file="expired")
    good = issue(own, "operator", tmp_path, file="good")
    without_key = Credentials(good.authority, secured.folder / "operator.pem", foreign.key)
    for invalid in (foreign, expired, without_key):
        with pytest.raises(zenoh.ZError):
            RawClient(secured.cell.endpoint, invalid, connect_ms=REFUSAL_MS)
    with RawClient(secured.cell.endpoint, good) as one:
        assert one.query("panda/motion/status")


def test_client_connects_to_no_false_router(secured: Secured, tmp_path: Path) -> None:
    (tmp_path / "ca.pem").write_bytes((secured.folder / "ca.pem").read_bytes())
    foreign = issue(Authority.new(10), ROUTER_NAME, tmp_path, hosts=["127.0.0.1"])
    task = credentials_of("panda.smart_pick_place", secured.folder)
    for false in (foreign, credentials_of("panda.camera_simulator", secured.folder)):
        endpoint = f"tls/127.0.0.1:{free_port()}"
        with zenoh.open(router_config([endpoint], false)), pytest.raises(zenoh.ZError):
            RawClient(endpoint, task, connect_ms=REFUSAL_MS)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    true = credentials_of(ROUTER_NAME, secured.folder)
    with zenoh.open(router_config([endpoint], true)), RawClient(endpoint, task) as client:
        assert client.connected


# --- a service's certificate, used for what the service does not do ---------------------------------------------------


def test_camera_cannot_command(secured: Secured) -> None:
    grip = encode(m.GripperCommand(id="by the camera", width=0.03))
    points = [m.JointTrajectoryPoint(time_from_start=t, positions=[0.0], velocities=[0.0], accelerations=[0.0])
              for t in (0.0, 1.0)]
    trajectory = m.JointTrajectory(joint_names=["no_such_joint"], points=points)
    still = encode(m.ExecuteRequest(id="by the camera", trajectory=trajectory))
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
            assert camera.query(f"panda/{key}", payload, timeout=0.5) == []
            camera.put(f"panda/{key}", payload)
        for key in ("gripper/state", "motion/status", "planning_scene", "detected_objects", "joint_states"):
            camera.put(f"panda/{key}", MARK)
            camera.delete(f"panda/{key}")
        assert camera.query("panda/**", grip, timeout=0.5) == []
        camera.put("panda/camera/camera_info", MARK)  # permitted, and behind all earlier messages
        received.wait_for("panda/camera/camera_info", MARK)
        assert [key for key, payload in received.samples if payload == MARK] == ["panda/camera/camera_info"]
        assert received.keys.isdisjoint(f"panda/{key}" for key in commands)
        counted = _received(operator)
        assert [key for key in commands if counted.get(key) != before.get(key)] == []
        assert decode(m.GripperState, operator.query("panda/gripper/state")[0]).id != "by the camera"
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
        assert detector.query_all(["panda/scene_balls", "panda/scene_objects", "panda/scene_$*"], timeout=1.0) == []
        assert not any(b"ball_" in answer for answer in detector.query_all(["panda/**", "**"], timeout=1.0))
        (truth,) = camera.query("panda/scene_objects")
        assert len(decode(m.WorldObjects, truth).objects) == 7
        assert stolen.keys.isdisjoint(TRUTH)
        assert detector.query("panda/camera/camera_info")


def test_service_cannot_impersonate_another(secured: Secured) -> None:
    with (secured.client("panda.camera_simulator") as camera, secured.client("operator") as operator,
          secured.client("ur5.contour_detector") as detector):
        there = operator.watch_tokens("*/alive/*")
        served = operator.watch_tokens("*/serves/**")
        for token in ("panda/alive/evil", "panda/alive/camera_opencv", "ur5/alive/contour_detector",
                      "panda/serves/motion/plan/camera_simulator"):
            camera.declare_token(token)
        asked = camera.serve("panda/motion/plan", MARK)
        camera.serve("panda/gripper/state", MARK)
        camera.serve("panda/**", MARK)
        camera.put("panda/camera/camera_info", MARK)
        operator.query("panda/camera/camera_info")
        assert {"panda/alive/evil", "ur5/alive/contour_detector"}.isdisjoint(operator.tokens("*/alive/*"))
        assert MARK not in operator.query("panda/gripper/state")
        assert MARK not in operator.query("panda/motion/plan", b"\x80")
        assert asked.samples == []
        detector.serve("ur5/outline/select", MARK)  # known when the tokens behind it are
        detector.declare_token("ur5/alive/contour_detector")
        detector.declare_token("ur5/serves/outline/select/contour_detector")
        there.wait_for("ur5/alive/contour_detector")
        served.wait_for("ur5/serves/outline/select/contour_detector")
        assert operator.query("ur5/outline/select", b"\x80") == [MARK]
        assert {"panda/alive/evil", "panda/alive/camera_opencv"}.isdisjoint(there.keys)
        assert "panda/serves/motion/plan/camera_simulator" not in served.keys


async def test_second_executor_is_refused_and_both_report_it(secured: Secured, tmp_path: Path) -> None:
    writers = set()

    def note_writer(sample: RawSample) -> None:
        attachment = decode_attachment(sample.attachment)
        assert attachment is not None
        writers.add(attachment.writer)

    async with connect(cell="panda", service="watcher", endpoint=secured.cell.endpoint, timeout=120) as bus:
        bus.raw_subscriber("panda/joint_states", note_writer)
        log = bus.reader(of_service(topics.LOG, "trajectory_executor"))
        second = asyncio.create_task(asyncio.to_thread(  # its own state folder: only the name conflicts
            secured.process, "service", "trajectory_executor", "--cell", "panda", ZENCELL_STATE=str(tmp_path)))
        reported = await until(log, lambda line: "another trajectory_executor" in line.message, 120)
        refused = await second
    assert "gives way: this one was there first" in reported.message
    assert refused.returncode == 2
    assert re.search(r"another trajectory_executor is up, which has \S+ already: end it first", refused.stderr)
    assert len(writers) == 1


def test_service_of_one_cell_cannot_read_another(secured: Secured) -> None:
    for name in ("ur5.motion_planner", "ur5.supervisor"):
        with secured.client(name) as stranger, secured.client("panda.motion_planner") as planner:
            stolen = stranger.subscribe("panda/joint_states", "panda/**", "**", "*/joint_states")
            planner.subscribe("panda/joint_states").wait(lambda samples: len(samples) > 10)
            assert stolen.samples == stranger.tokens("panda/alive/*", timeout=1.0) == []
            keys = ["panda/planning_scene", "panda/motion/plan", "panda/motion/status"]
            assert stranger.query_all(keys, timeout=1.0) == []
            assert planner.query("panda/planning_scene")


def test_observer_reads_everything_and_commands_nothing(secured: Secured) -> None:
    with secured.client("observer") as observer, secured.client("operator") as operator:
        received = observer.subscribe("panda/**")
        received.wait(lambda samples: {"panda/scene_balls", "panda/joint_states"} <= {key for key, _ in samples})
        assert observer.query("panda/motion/status")
        stop = encode(m.StopRequest())
        assert observer.query_all(["panda/motion/stop", "panda/motion/*", "panda/**"], stop, timeout=1.0) == []
        assert operator.query("panda/motion/stop", stop)
        release = encode(m.HoldRequest(hold=False, stops=True, acknowledged=time.time_ns()))
        assert operator.query("panda/motion/hold", release)  # for the tests after it


@pytest.mark.usefixtures("same_processes")
def test_counters_in_the_name_of_another_service_are_refused_and_not_copied(secured: Secured) -> None:
    forged = encode(m.ServiceCounters(service="vision_detector", received={"by the camera": 1}))
    with secured.client("panda.camera_simulator") as camera, secured.client("operator") as operator:
        counters, plain = operator.subscribe("panda/counters/**"), operator.subscribe("panda/counters")
        counters.wait_for("panda/counters/vision_detector")

        def refused(samples: list[tuple[str, bytes]]) -> bool:
            # Only the last one is permitted.
            for key in ("counters/vision_detector", "counters", "counters/camera_simulator"):
                camera.put(f"panda/{key}", forged)
            return any(one.service == "supervisor" and one.invalid.get(topics.COUNTERS.key)
                       for one in _counters(samples))

        counters.wait(refused)
        own_keys = {key for key, payload in counters.samples if payload == forged}
        assert own_keys == {"panda/counters/camera_simulator"}
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
        for _ in range(10):
            for _ in range(1000):
                camera.put("panda/log/camera_simulator", MARK)
                camera.put("panda/camera/image_raw", bytes(100))
            before = len(joints.samples)
            assert operator.query("panda/motion/status", timeout=20.0)
            joints.wait(lambda samples, seen=before: len(samples) > seen)  # type: ignore[misc]


@pytest.mark.usefixtures("same_processes")
def test_router_drops_messages_that_are_too_large_for_their_topic(secured: Secured) -> None:
    with (secured.client("panda.camera_simulator") as camera, secured.client("panda.vision_detector") as detector,
          secured.client("panda.scene_manager") as other):
        received = detector.subscribe("panda/camera/camera_info", "panda/camera/image_raw")
        own = other.subscribe("panda/camera/camera_info")
        received.wait_for("panda/camera/image_raw")  # of the service: the subscriptions have taken effect
        camera.put("panda/camera/camera_info", bytes(MAX_OTHER_BYTES + 1))
        camera.put("panda/camera/camera_info", MARK)
        received.wait_for("panda/camera/camera_info", MARK)
        camera.put("panda/camera/image_raw", bytes(MAX_BYTES + 1))  # the router closes the camera's link
        _wait_reconnected(camera, received)
        assert max(len(payload) for _, payload in received.samples) < MAX_OTHER_BYTES
        own.wait_for("panda/camera/camera_info")
        assert other.connected


def _wait_reconnected(camera: RawClient, received: Received) -> None:
    """Return when messages of the camera arrive again."""
    before, again = len(received.samples), ("panda/camera/camera_info", b"again")
    for _ in range(200):
        camera.put("panda/camera/camera_info", b"again")
        try:
            if received.wait_until(lambda samples: again in samples[before:], 0.1):
                return
        except zenoh.ZError:
            continue
    raise AssertionError("no message of the camera arrived after its link had been closed")


# --- the machine, the tools, and recorded files -----------------------------------------------------------------------


def test_only_router_and_page_listen_and_only_on_the_loopback_address(secured: Secured) -> None:
    listening, datagrams = sockets_of(secured.processes)
    shown = {("router", "127.0.0.1", secured.port), ("viewer", "127.0.0.1", secured.page)}
    inner = listening - shown  # where the TLS gate forwards to, and the listener for services of this host
    assert [(name, address) for name, address, _ in inner] == [("router", "127.0.0.1")] * 2
    assert listening > shown
    assert datagrams == set()


def test_services_of_the_supervisor_bypass_the_tls_gate(secured: Secured) -> None:
    processes = secured.processes
    listening = {each.laddr.port for each in processes.pop("router").net_connections("tcp") if each.status == "LISTEN"}
    for name, process in processes.items():
        links = [each for each in process.net_connections("tcp") if each.status == psutil.CONN_ESTABLISHED]
        ports = {each.raddr.port for each in links} & listening
        assert ports and secured.port not in ports, name


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
    for name in ("ca.pem", "observer.pem", "observer.key"):
        (tmp_path / name).write_bytes((secured.folder / name).read_bytes())
    (tmp_path / "observer.key").chmod(0o600)
    file = tmp_path / "seen.mcap"
    made = secured.process("record", "--duration", "2", "-o", str(file), ZENCELL_SECURE=str(tmp_path))
    assert made.returncode == 0, made.stderr
    with Recording(file) as recording:
        assert {"panda/joint_states", "panda/motion/status", "panda/scene_objects"} <= {
            sample.key for sample in recording.samples()}


def test_no_secret_is_in_files_output_or_command_lines_of_a_cell(secured: Secured) -> None:
    """The last test of this file: it ends the cell."""
    listed = secured.tool("param", "list")
    assert "services.viewer.token" not in listed.stdout or TOKEN not in listed.stdout
    commands = [" ".join(process.info["cmdline"] or []) for process in psutil.process_iter(["cmdline"])]
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
        written = {sample.payload for sample in recording.samples() if len(sample.payload) < IMAGE}
    files = [path for path in secured.cell.folder.rglob("*") if path.is_file()]
    assert len(files) >= 3
    written |= {path.read_bytes() for path in files if path.suffix != ".mcap"}
    text = b"\0".join([*written, listed.stdout.encode(), listed.stderr.encode()])
    for secret in secrets:
        assert secret not in text
    assert not any(TOKEN in command for command in commands)
