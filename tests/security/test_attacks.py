"""A secured cell with its page, and what people try on it who hold no certificate, a wrong one, or one of the cell's.

What is denied to one is shown to be allowed to another, so that a denial is one.
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
from tests.security.holders import REFUSED, Heard, Holder
from zencell.blocking import Cell

pytestmark = [pytest.mark.cell, pytest.mark.slow, pytest.mark.timeout(300)]

TOKEN = "the-token-of-this-page-0123456789"
TRUTH = {"panda/scene_balls", "panda/scene_objects"}
MARK = b"attack"
SERVICES = 9
PATIENT = ("--set", "watchdogs.silence=0", "--set", "watchdogs.loop=0")  # who dies here was killed by an attack


@dataclass
class Secured:
    """A cell that is up, and the folder of its certificates."""

    cell: RunningCell
    folder: Path
    page: int
    recording: Path

    def holder(self, name: str) -> Holder:
        """Somebody with the certificate of a common name."""
        return Holder(self.cell.endpoint, credentials_of(name, self.folder))

    @property
    def environment(self) -> dict[str, str]:
        return {**environment(), "ZENCELL_SECURE": str(self.folder), "ZENCELL_DOMAIN": str(self.cell.domain)}

    def tool(self, *arguments: str, **told: str) -> subprocess.CompletedProcess[str]:
        """A command of zencell that is told of the certificates, and of what else stands in its environment."""
        return subprocess.run(
            command_line(*arguments), env={**self.environment, **told}, cwd=self.cell.folder, capture_output=True,
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
            folder, "up", "panda", "--secure", str(certificates), "--set", "autostart=false", *PATIENT,
            "--viewer-port", str(page), "--record", str(recording), secrets={"ZENCELL_VIEWER_TOKEN": TOKEN},
        ) as cell:

            async def ready() -> None:
                async with connect(cell="panda", service="watcher", endpoint=cell.endpoint, timeout=120) as bus:
                    await until(bus.reader(topics.SUPERVISOR_STATUS), all_ready, timeout=120)

            try:
                asyncio.run(ready())
            except (TimeoutError, NoRouter):
                pytest.fail(f"the cell did not come up:\n{cell.tail()}")
            yield Secured(cell, certificates, page, recording)


def all_ready(status: m.SupervisorStatus) -> bool:
    return len(status.services) > SERVICES and all(service.state == "ready" for service in status.services)


@pytest.fixture
def same_processes(secured: Secured) -> Iterator[None]:
    """Nobody dies during the test."""
    before = {name: process.pid for name, process in secured.cell.processes().items()}
    yield
    assert {name: process.pid for name, process in secured.cell.processes().items()} == before
    with secured.holder("operator") as operator:
        assert len(operator.tokens("panda/alive/*")) >= SERVICES


@pytest.mark.usefixtures("same_processes")
def test_program_with_the_operators_certificate_does_what_the_camera_may_not(
    secured: Secured, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("ZENCELL_SECURE", raising=False)
    edit = m.SceneEdit(op="add", id="post", shape="sphere", dimensions=[0.05],
                       pose=m.Pose(position=m.Vector3(x=-0.5, z=0.5)))
    with (secured.holder("panda.camera_simulator") as camera,
          Cell(domain=secured.cell.domain, secure=str(secured.folder), owner="anna") as cell):
        assert cell.name == "panda" and cell.arm.move("home").state == "succeeded"
        assert camera.ask("panda/scene/edit", encode(edit), timeout=1.0) == []
        assert cell.scene.objects() == []
        assert cell.call("scene/edit", edit).ids == ["added/post"]
        assert [solid.id for solid in cell.scene.objects()] == ["added/post"] and cell.scene.remove("post") == []


# --- who holds no certificate, or a wrong one ------------------------------------------------------------------------


def test_whoever_has_no_certificate_is_not_let_in(secured: Secured) -> None:
    open_endpoint = secured.cell.endpoint.replace("tls/", "tcp/")
    with pytest.raises(zenoh.ZError):
        Holder(open_endpoint, None, connect_ms=REFUSED)
    bare = client_config(secured.cell.endpoint, connect_ms=REFUSED)
    bare.insert_json5("transport/link/tls", json.dumps({
        "root_ca_certificate": str(secured.folder / "ca.pem"), "verify_name_on_connect": True,
    }))
    with pytest.raises(zenoh.ZError):
        zenoh.open(bare)
    with secured.holder("panda.camera_simulator") as camera:
        assert camera.connected


@pytest.mark.parametrize("fault", ["foreign authority", "run out", "authority's own name only"])
def test_a_certificate_that_is_not_valid_does_not_open(secured: Secured, tmp_path: Path, fault: str) -> None:
    own = Authority.load(secured.folder / "ca.pem", secured.folder / "ca.key")
    signer = Authority.new(10) if fault != "run out" else own
    made = Credentials(secured.folder / "ca.pem", tmp_path / "operator.pem", tmp_path / "operator.key")
    signer.issue("operator", [], -1 if fault == "run out" else 10, made.certificate, made.key)
    if fault == "authority's own name only":  # a key of one's own under a certificate that is public
        made = Credentials(made.authority, secured.folder / "operator.pem", made.key)
    with pytest.raises(zenoh.ZError):
        Holder(secured.cell.endpoint, made, connect_ms=REFUSED)
    own.issue("operator", [], 10, tmp_path / "good.pem", tmp_path / "good.key")
    good = Credentials(made.authority, tmp_path / "good.pem", tmp_path / "good.key")
    with Holder(secured.cell.endpoint, good) as one:
        assert one.ask("panda/motion/status")


@pytest.mark.parametrize("who", ["foreign router", "a service of the cell"])
def test_nobody_else_is_taken_for_the_router(secured: Secured, tmp_path: Path, who: str) -> None:
    if who == "foreign router":
        Authority.new(10).issue(ROUTER_NAME, ["127.0.0.1"], 10, tmp_path / "router.pem", tmp_path / "router.key")
        false = Credentials(secured.folder / "ca.pem", tmp_path / "router.pem", tmp_path / "router.key")
    else:
        false = credentials_of("panda.camera_simulator", secured.folder)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    task = credentials_of("panda.smart_pick_place", secured.folder)
    with zenoh.open(router_config([endpoint], false)), pytest.raises(zenoh.ZError):
        Holder(endpoint, task, connect_ms=REFUSED)
    true = credentials_of(ROUTER_NAME, secured.folder)
    with zenoh.open(router_config([endpoint], true)), Holder(endpoint, task) as let_in:
        assert let_in.connected


# --- who holds the certificate of a service, and does what it does not ------------------------------------------------


def test_a_camera_can_not_command(secured: Secured) -> None:
    grip = encode(m.GripperCommand(id="by the camera", width=0.03))
    still = encode(m.ExecuteRequest(id="by the camera", trajectory=m.JointTrajectory(
        joint_names=["nobody"], points=[
            m.JointTrajectoryPoint(time_from_start=t, positions=[0.0], velocities=[0.0], accelerations=[0.0])
            for t in (0.0, 1.0)
        ])))
    edit = encode(m.WorldEdit(op="reset"))
    commands = {"motion/execute": still, "motion/stop": encode(m.StopRequest()), "gripper/command": grip,
                "world/edit": edit, "task/command": encode(m.TaskCommand(command="start")),
                "motion/hold": encode(m.HoldRequest(hold=True)), "param/vision_detector": encode(m.ParameterRequest())}
    with (secured.holder("panda.camera_simulator") as camera, secured.holder("panda.smart_pick_place") as task,
          secured.holder("operator") as operator):
        before = _received(operator)
        heard = operator.hear("panda/**")
        heard.wait_for("panda/joint_states")
        for key, payload in commands.items():
            assert camera.ask(f"panda/{key}", payload, timeout=1.0) == []
            camera.put(f"panda/{key}", payload)
        for key in ("gripper/state", "motion/status", "planning_scene", "detected_objects", "joint_states"):
            camera.put(f"panda/{key}", MARK)
            camera.delete(f"panda/{key}")
        assert camera.ask("panda/**", grip, timeout=1.0) == []
        camera.put("panda/camera/camera_info", MARK)  # its own: what it sent before is through as well
        heard.wait_for("panda/camera/camera_info", MARK)
        assert [key for key, payload in heard.samples if payload == MARK] == ["panda/camera/camera_info"]
        assert heard.keys.isdisjoint(f"panda/{key}" for key in commands)
        counted = _received(operator)
        assert [key for key in commands if counted.get(key) != before.get(key)] == []
        gripper = decode(m.GripperState, operator.ask("panda/gripper/state")[0])
        assert gripper.id != "by the camera"
        assert "autostart" not in secured.cell.tail()
        (answer,) = task.ask("panda/gripper/command", encode(m.GripperCommand(id="by the task", width=0.05)))
        assert decode(m.GripperState, answer).id == "by the task"
        (answer,) = task.ask("panda/motion/execute", still)
        assert decode(m.MotionStatus, answer).state == "rejected"  # by the executor, which heard it
        (answer,) = operator.ask("panda/world/edit", edit)
        assert len(decode(m.WorldEditReply, answer).ids) == 7


def _received(operator: Holder) -> dict[str, int]:
    """What the executor counts of what came, by key."""
    told = operator.hear("panda/counters/*")
    told.wait(lambda samples: any(one.service == "trajectory_executor" for one in _counters(samples)))
    return [one for one in _counters(told.samples) if one.service == "trajectory_executor"][-1].received


def _counters(samples: list[tuple[str, bytes]]) -> list[m.ServiceCounters]:
    return [decode(m.ServiceCounters, payload) for _, payload in samples]


def test_a_detector_can_not_read_the_truth(secured: Secured) -> None:
    with secured.holder("panda.vision_detector") as detector, secured.holder("panda.camera_simulator") as camera:
        stolen = detector.hear(*TRUTH, "panda/scene_$*", "panda/*", "panda/**", "**")
        pictures = detector.hear("panda/camera/image_raw")
        seen = camera.hear("panda/scene_objects")
        seen.wait(lambda samples: len(samples) > 1)  # it is told again each second
        pictures.wait_for("panda/camera/image_raw")
        for key in ("panda/scene_balls", "panda/scene_objects", "panda/scene_$*", "panda/**", "**"):
            answers = detector.ask(key, timeout=1.0)
            assert not any(b"ball_" in answer for answer in answers)
            assert key in {"panda/**", "**"} or answers == []
        (truth,) = camera.ask("panda/scene_objects")
        assert len(decode(m.WorldObjects, truth).objects) == 7
        assert stolen.keys.isdisjoint(TRUTH)
        assert detector.ask("panda/camera/camera_info")


def test_a_service_can_not_pass_for_another(secured: Secured) -> None:
    with (secured.holder("panda.camera_simulator") as camera, secured.holder("operator") as operator,
          secured.holder("ur5.contour_detector") as detector):
        there = operator.watch("*/alive/*")
        served = operator.watch("*/serves/**")
        for name in ("evil", "camera_opencv"):
            camera.claim(f"panda/alive/{name}")
        camera.claim("ur5/alive/contour_detector")
        camera.claim("panda/serves/motion/plan/camera_simulator")
        asked = camera.answer("panda/motion/plan", MARK)
        camera.answer("panda/gripper/state", MARK)
        camera.answer("panda/**", MARK)
        camera.put("panda/camera/camera_info", MARK)
        operator.ask("panda/camera/camera_info")
        assert {"panda/alive/evil", "ur5/alive/contour_detector"}.isdisjoint(operator.tokens("*/alive/*"))
        assert MARK not in operator.ask("panda/gripper/state")
        assert MARK not in operator.ask("panda/motion/plan", b"\x80")
        assert asked.samples == []
        detector.claim("ur5/alive/contour_detector")
        detector.claim("ur5/serves/outline/select/contour_detector")
        detector.answer("ur5/outline/select", MARK)
        there.wait_for("ur5/alive/contour_detector")
        served.wait_for("ur5/serves/outline/select/contour_detector")
        assert operator.ask("ur5/outline/select", b"\x80") == [MARK]
        assert {"panda/alive/evil", "panda/alive/camera_opencv"}.isdisjoint(there.keys)
        assert "panda/serves/motion/plan/camera_simulator" not in served.keys


async def test_a_second_executor_with_the_same_certificate_is_refused_and_both_say_so(
    secured: Secured, tmp_path: Path
) -> None:
    writers = set()

    def take(sample: RawSample) -> None:
        sent = decode_attachment(sample.attachment)
        assert sent is not None
        writers.add(sent.writer)

    async with connect(cell="panda", service="watcher", endpoint=secured.cell.endpoint, timeout=120) as bus:
        bus.raw_subscriber("panda/joint_states", take)
        log = bus.reader(of_service(topics.LOG, "trajectory_executor"))
        second = asyncio.create_task(asyncio.to_thread(  # with a record of its own: its name alone is taken
            secured.tool, "service", "trajectory_executor", "--cell", "panda", ZENCELL_STATE=str(tmp_path)))
        told = await until(log, lambda line: "another trajectory_executor" in line.message, 120)
        refused = await second
    assert re.search(r"another trajectory_executor \(process \w+\) claims \S+ too and gives way: this one was there "
                     r"first", told.message)
    assert refused.returncode == 2
    assert re.search(r"services\.trajectory_executor: another trajectory_executor is up, which has \S+ already: end it "
                     r"first, or start one$", refused.stderr.strip()), refused.stderr
    assert len(writers) == 1


@pytest.mark.parametrize("name", ["ur5.motion_planner", "ur5.supervisor"])
def test_one_cell_can_not_look_into_another(secured: Secured, name: str) -> None:
    with secured.holder(name) as stranger, secured.holder("panda.motion_planner") as planner:
        stolen = stranger.hear("panda/joint_states", "panda/**", "**", "*/joint_states")
        own = planner.hear("panda/joint_states")
        own.wait(lambda samples: len(samples) > 10)
        assert stolen.samples == []
        assert stranger.tokens("panda/alive/*") == []
        for key in ("panda/planning_scene", "panda/motion/plan", "panda/motion/status"):
            assert stranger.ask(key, timeout=1.0) == []
        assert planner.ask("panda/planning_scene")


def test_an_observer_sees_everything_and_commands_nothing(secured: Secured) -> None:
    with secured.holder("observer") as observer, secured.holder("operator") as operator:
        heard = observer.hear("panda/**")
        heard.wait(lambda samples: {"panda/scene_balls", "panda/joint_states"} <= {key for key, _ in samples})
        assert observer.ask("panda/motion/status")
        stop = encode(m.StopRequest())
        for key in ("panda/motion/stop", "panda/motion/*", "panda/**"):
            assert observer.ask(key, stop, timeout=1.0) == []
        assert operator.ask("panda/motion/stop", stop)
        let_go = encode(m.HoldRequest(hold=False, stops=True))
        assert operator.ask("panda/motion/hold", let_go)  # for the tests after it


@pytest.mark.usefixtures("same_processes")
def test_nobody_says_for_another_that_it_lives(secured: Secured) -> None:
    forged = encode(m.ServiceCounters(service="vision_detector", received={"by the camera": 1}))
    with secured.holder("panda.camera_simulator") as camera, secured.holder("operator") as operator:
        told = operator.hear("panda/counters/**")
        told.wait_for("panda/counters/vision_detector")

        def refused(samples: list[tuple[str, bytes]]) -> bool:
            for key in ("counters/vision_detector", "counters", "counters/camera_simulator"):  # the last is its own
                camera.put(f"panda/{key}", forged)
            return any(one.service == "supervisor" and one.invalid.get(topics.COUNTERS.key)
                       for one in _counters(samples))

        told.wait(refused)
        assert {key for key, payload in told.samples if payload == forged} == {"panda/counters/camera_simulator"}


def test_plain_counters_hold_what_the_supervisor_repeats_and_nothing_else(secured: Secured) -> None:
    forged = encode(m.ServiceCounters(service="vision_detector", received={"by the camera": 1}))
    with secured.holder("panda.camera_simulator") as camera, secured.holder("operator") as operator:
        told = operator.hear("panda/counters")
        for _ in range(10):
            camera.put("panda/counters", forged)
        both = {"vision_detector", "camera_simulator"}
        told.wait(lambda samples: both <= {one.service for one in _counters(samples)})
        assert forged not in [payload for _, payload in told.samples]


# --- who does what it may, in a way that harms -----------------------------------------------------------------------


@pytest.mark.usefixtures("same_processes")
def test_a_flood_starves_nobody(secured: Secured) -> None:
    with (secured.holder("panda.camera_simulator") as camera, secured.holder("operator") as operator,
          secured.holder("panda.motion_planner") as planner):
        joints = planner.hear("panda/joint_states")
        joints.wait_for("panda/joint_states")
        answered = 0
        for _ in range(20):
            for _ in range(1000):
                camera.put("panda/log/camera_simulator", MARK)
                camera.put("panda/camera/image_raw", bytes(100))
            before = len(joints.samples)
            answered += len(operator.ask("panda/motion/status", timeout=20.0))
            joints.wait(lambda samples, seen=before: len(samples) > seen)  # type: ignore[misc]
        assert answered == 20


async def test_messages_that_are_none_are_counted_and_harm_nobody(secured: Secured, same_processes: None) -> None:
    good = encode(m.Image(header=m.Header(), height=1, width=1, encoding="bgr8", data=bytes(3)))
    lying = encode(m.Image(header=m.Header(), height=1, width=1, encoding="bgr8", data=bytes(3)).model_copy(
        update={"height": 2**31, "width": 2**31}))
    bad = [b"", MARK, b"\xc1", good[:-2], good + b"\0", lying, b"\xdf\xff\xff\xff\xff", b"\x91" * 5000,
           bytes(DEFAULT_LIMIT + 1)]
    name = topics.CAMERA_IMAGE.key

    def refused(counters: m.ServiceCounters) -> bool:
        return counters.service == "vision_detector" and counters.invalid.get(name, 0) >= before + len(bad) + 1

    with secured.holder("panda.camera_simulator") as camera:
        async with secured.cell.listen() as bus:
            counters = bus.reader(topics.COUNTERS)
            first = await until(counters, lambda one: one.service == "vision_detector")
            before = first.invalid.get(name, 0)
            camera.put(f"panda/{name}", good, attachment=b"\xc1 not ours")
            for payload in bad:
                camera.put(f"panda/{name}", payload)
                await asyncio.sleep(0.3)  # a stream keeps only the newest of a sender
            while not refused(await until(counters, lambda one: one.service == "vision_detector")):
                camera.put(f"panda/{name}", MARK)
            found = bus.reader(DETECTED_OBJECTS)
            assert await found.next()  # from the true pictures


@pytest.mark.usefixtures("same_processes")
def test_what_is_larger_than_anything_of_its_topic_goes_no_farther_than_the_router(secured: Secured) -> None:
    with (secured.holder("panda.camera_simulator") as camera, secured.holder("panda.vision_detector") as detector,
          secured.holder("panda.scene_manager") as other):
        heard = detector.hear("panda/camera/camera_info", "panda/camera/image_raw")
        own = other.hear("panda/camera/camera_info")
        camera.put("panda/camera/camera_info", bytes(MAX_OTHER_BYTES + 1))
        camera.put("panda/camera/camera_info", MARK)
        heard.wait_for("panda/camera/camera_info", MARK)
        camera.put("panda/camera/image_raw", bytes(MAX_BYTES + 1))  # ends its own link
        _again(camera, heard)
        assert max(len(payload) for _, payload in heard.samples) < MAX_OTHER_BYTES
        assert other.connected
        assert own.keys


def _again(camera: Holder, heard: Heard) -> None:
    """Return when the camera is heard again."""
    told = len(heard.samples)
    for _ in range(200):
        camera.put("panda/camera/camera_info", b"again")
        try:
            with heard._changed:
                if heard._changed.wait_for(lambda: ("panda/camera/camera_info", b"again") in heard.samples[told:], 0.1):
                    return
        except zenoh.ZError:
            continue
    raise AssertionError("the camera was not heard again")


async def test_a_command_that_is_sent_again_moves_nothing(secured: Secured) -> None:
    def tell(holder: Holder, key: str, message: m.Message) -> bytes:
        (answer,) = holder.ask(f"panda/{key}", encode(message), timeout=10.0)
        return answer

    with secured.holder("panda.smart_pick_place") as task:
        async with connect(cell="panda", service="watcher", endpoint=secured.cell.endpoint, timeout=10) as bus:
            gripper, motion = bus.reader(topics.GRIPPER_STATE), bus.reader(topics.MOTION_STATUS)
            for identity, width in (("first", 0.02), ("second", 0.06)):
                command = m.GripperCommand(id=identity, width=width)
                await asyncio.to_thread(tell, task, "gripper/command", command)
                await until(gripper, lambda state, wanted=identity: state.id == wanted and state.state == "succeeded")
            replayed = await asyncio.to_thread(tell, task, "gripper/command", m.GripperCommand(id="first", width=0.02))
            assert decode(m.GripperState, replayed).id == "first"
            scenes = bus.reader(topics.PLANNING_SCENE)
            assert scenes.latest or await scenes.next()
            joints = bus.reader(topics.JOINT_STATES)
            begin = await joints.next()
            there = [q + 0.3 if index == 0 else q for index, q in enumerate(begin.position[:7])]
            goal = m.PlanRequest(id="plan", stage="replay", goal=m.JointGoal(positions=there), planning_time=5.0)
            plan = decode(m.PlanResponse, await asyncio.to_thread(tell, task, "motion/plan", goal))
            assert plan.trajectory is not None, plan.message
            captured = m.ExecuteRequest(header=bus.header(), id="captured", trajectory=plan.trajectory)
            await asyncio.to_thread(tell, task, "motion/execute", captured)
            await until(motion, lambda status: status.id == "captured" and status.state == "succeeded")
            again = decode(m.MotionStatus, await asyncio.to_thread(tell, task, "motion/execute", captured))
            assert (again.id, again.state) == ("captured", "succeeded")
            long_ago = m.Header(stamp=captured.header.stamp - 10_000_000_000)
            for header, error in ((long_ago, "stale_request"), (bus.header(), "start_mismatch")):
                renamed = captured.model_copy(update={"id": f"renamed {error}", "header": header})
                refused = decode(m.MotionStatus, await asyncio.to_thread(tell, task, "motion/execute", renamed))
                assert (refused.state, refused.error) == ("rejected", error)
            assert motion.latest is not None
            assert motion.latest.state != "active"
            end = await joints.next()
            assert end.position[0] == pytest.approx(there[0], abs=0.01)
            (state,) = await asyncio.to_thread(task.ask, "panda/gripper/state")
            assert decode(m.GripperState, state).width == pytest.approx(0.06, abs=0.002)


# --- the page, the machine, the tools, and what is left behind -------------------------------------------------------


def test_the_page_is_for_those_who_have_its_token(secured: Secured) -> None:
    address = f"http://127.0.0.1:{secured.page}/"
    for given in ("", "?token=", "?token=guessed-guessed-guessed"):
        with pytest.raises(urllib.error.HTTPError) as refused:
            urllib.request.urlopen(address + given, timeout=30)
        assert refused.value.code == 401
        refused.value.close()
    with urllib.request.urlopen(f"{address}?token={TOKEN}", timeout=30) as answer:
        assert answer.status == 200


def test_nothing_listens_but_the_router_and_the_page_and_only_on_this_machine(secured: Secured) -> None:
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
    inner = listening - shown  # what the router's front passes on to, and where services of this host come in
    assert [(name, address) for name, address, _ in inner] == [("router", "127.0.0.1")] * 2
    assert listening > shown
    assert datagrams == []


def test_what_the_supervisor_starts_comes_in_near_the_router_and_not_through_its_front(secured: Secured) -> None:
    processes = {**secured.cell.processes(), "supervisor": psutil.Process(secured.cell.process.pid)}
    router = processes.pop("router")
    front = int(secured.cell.endpoint.rpartition(":")[2])
    listening = {each.laddr.port for each in router.net_connections("tcp") if each.status == psutil.CONN_LISTEN}
    for name, process in processes.items():
        made = [each.raddr.port for each in process.net_connections("tcp")
                if each.status == psutil.CONN_ESTABLISHED and each.raddr.port in listening]
        assert made and front not in made, name


def test_tools_show_the_certificate_of_the_operator(secured: Secured) -> None:
    assert "trajectory_executor" in secured.tool("node", "list").stdout
    values = secured.tool("param", "get", "services.vision_detector.min_contour_area_px")
    assert values.returncode == 0, values.stderr
    echoed = secured.tool("topic", "echo", "joint_states", "-n", "1")
    assert "panda_joint1" in echoed.stdout, echoed.stderr
    refused = secured.tool("topic", "pub", "joint_states", "{}", "--once")
    assert (refused.returncode, refused.stderr.count("\n")) == (2, 1)
    assert "only a cell's own services publish" in refused.stderr


def test_a_recording_is_made_with_no_other_certificate_than_the_observers(secured: Secured, tmp_path: Path) -> None:
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


def test_no_secret_is_in_anything_that_a_cell_leaves(secured: Secured) -> None:
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
