"""`zencell report`: figures, tables and charts of a recorded run."""

import importlib
import re

import numpy as np
import pytest

from applications.pick_place.topics import PickPlaceStatus
from common import messages as m
from tests.cli.run_tape import BEGIN, Tape, report
from tests.harness import own_modules

ARM = [f"panda_joint{k}" for k in range(1, 8)]
UR5 = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
NASTY = '<script>alert("1")</script> & $x^2$'


def point(x, y, z=0.03):
    return m.Vector3(x=x, y=y, z=z)


def pose(x, y, z=0.03):
    return m.Pose(position=point(x, y, z))


def pick_and_place(tape):
    plans = [m.PlanFigure(planner="cartesian", seconds=0.012, fraction=1.0, attempts=1),
             m.PlanFigure(planner="ompl", seconds=0.345, fraction=1.0, attempts=3)]
    ball = m.CollisionObject(id="ball_1", role="target", shape="sphere", dimensions=[0.03], pose=pose(0.5, 0.1))
    table = m.CollisionObject(id="table", role="fixture", shape="box", dimensions=[1, 1, 0.05],
                              pose=pose(0.5, 0, -0.025))
    service = m.ServiceStatus(name="vision_detector", state="ready", ready_seconds=1.25)
    tape.put(0, "supervisor/status", m.SupervisorStatus(cell="panda", services=[service]))
    tape.put(0.1, "planning_scene", m.PlanningScene(header=tape.header(0.1), objects=[ball, table]))
    tape.task(0.2, "IDLE", targets=2)
    for t in 0.25 + 0.02 * np.arange(100):
        tape.put(t, "joint_states", m.JointState(
            header=tape.header(t), name=ARM, position=[0.3 * np.sin(t), 0.1, 0, -1.5, 0, 1.5, 0.2],
            velocity=[0.1] * 6 + [-1.305]))
    for k in range(10):
        t = 0.3 + 0.1 * k
        exposed = tape.header(t - 0.001 * (k + 1))  # 1 to 10 ms old
        marker = m.Marker(ns="ball", id=0, type="sphere", pose=pose(0.5, 0.1), scale=point(1, 1, 1))
        tape.put(t - 0.0005, "detected_objects", m.MarkerArray(header=exposed, markers=[marker]))
        tape.put(t, "validated_targets", m.PoseArray(header=exposed, poses=[pose(0.5, 0.1)]))
    tape.put(0.5, "rejected_targets", m.Rejections(
        header=tape.header(0.5), rejected=[m.Rejection(position=point(0.2, 0.0), reason=f"too near {NASTY}")]))
    for k in range(len(plans)):
        rest = {"positions": [0] * 7, "velocities": [0] * 7, "accelerations": [0] * 7}
        last = m.JointTrajectoryPoint(time_from_start=2.5 + k, **rest)
        tape.put(0.6 + k, "display_trajectory", m.JointTrajectory(joint_names=ARM, points=[last]))
        tape.task(0.65 + k, "GRASPING", target="ball_1", started=True, targets=2, plans=plans[: k + 1],
                  planning_seconds=sum(p.seconds for p in plans[: k + 1]))
        tape.put(0.7 + k, "motion/status", m.MotionStatus(id=f"goal_{k}", state="active"))
        result = {"state": "aborted", "error": "path_tolerance", "message": "joint 3 is 0.2 rad off"} if k else {
            "state": "succeeded"}
        tape.put(1.2 + k, "motion/status", m.MotionStatus(id=f"goal_{k}", source="arm_controller", **result))
    tape.put(1.3, "gripper/state", m.GripperState(holding=True))
    tape.put(1.8, "gripper/state", m.GripperState(holding=False))
    service = service.model_copy(update={"restarts": 1, "message": "killed by SIGKILL"})
    tape.put(1.9, "supervisor/status", m.SupervisorStatus(cell="panda", services=[service]))
    tape.put(2.0, "log", m.LogLine(service="motion_planner", level="warning", message=f"no way: {NASTY}"))
    tape.put(2.0, "log", m.LogLine(service="motion_planner", level="info", message="not shown"))
    tape.put(2.1, "counters", m.ServiceCounters(service="vision_detector", dropped={"camera/image_raw": 12},
                                                invalid={"camera/image_raw": 3}, overflow={"x": 1}))
    tape.put(2.2, "scene_balls", m.PoseArray(
        header=tape.header(2.2), labels=["box", "table"], poses=[pose(0.55, 0.25), pose(0.2, 0)]))
    tape.task(2.5, "DONE", started=True, placed=1, targets=2, failures=4, retries=5, plans=plans, moving_seconds=1.75,
              planning_seconds=0.357, task_seconds=2.25,
              skipped=[m.Rejection(position=point(0.3, 0.3), reason="given up after 3 tries")])


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    tape = Tape(tmp_path_factory.mktemp("report") / "run.mcap")
    pick_and_place(tape)
    return tape.report(dropped={"panda/joint_states": 2}, missed={"panda/joint_states": 3})


def test_page_has_every_section_and_requests_nothing(page):
    assert list(page.sections) == [
        "summary", "timeline", "top", "plans", "latency", "joints", "problems", "services", "log"]
    assert all(reference.startswith("#") for reference in page.requested)
    assert "<script" not in page.text and "@import" not in page.text and not re.search(r"url\((?!#)", page.text)
    assert page.tags.count("svg") == 5 and not page.captions


def test_figures_are_the_recorded_ones(page):
    for part in ("panda: DONE", "placed 1 of 2", "rejected places 2", "truth 1 in the box, 1 on the table",
                 "moving 1.8 s", "planning 0.4 s in 2 plans", "failures, retries 4, 5", "restarts 1 x", "seed 7",
                 "2.5 s", "frame to target 5.0 ms (median)", "zencell 0.1.0"):
        assert part in page.head, part
    assert page.table("plans") == [["1", "0.60", "cartesian", "12.0", "1", "1.00", "2.50"],
                                   ["2", "1.60", "ompl", "345.0", "3", "1.00", "3.50"]]
    assert "10 frames: median 5.5 ms" in page.sections["latency"] and "at most 10.0 ms" in page.sections["latency"]
    assert "1 picked, 1 rejected" in page.sections["top"]
    rows = {row[0]: row for row in page.table("joints")}
    assert set(rows) == set(ARM)
    assert rows["panda_joint7"][1:] == ["0.200", "0.200", "1.305", "-2.897 to 2.897", "2.610", "50%"]
    assert float(rows["panda_joint1"][2]) == pytest.approx(0.3 * np.sin(1.5708), abs=2e-3)


def test_problems_are_listed_in_time_with_their_reason(page):
    assert page.table("problems") == [
        ["0.50", "rejected", "(0.200, 0.000, 0.030)", f"too near {NASTY}"],
        ["1.90", "restarted", "vision_detector", "killed by SIGKILL"],
        ["2.20", "motion aborted", "goal_1", "joint 3 is 0.2 rad off [arm_controller]"],
        ["2.50", "skipped", "(0.300, 0.300, 0.030)", "given up after 3 tries"],
    ]
    assert page.table("log") == [["2.00", "warning", "motion_planner", f"no way: {NASTY}"]]
    assert page.table("services") == [["vision_detector", "ready", "1.25", "1", "12", "3", "1"]]
    assert "joint_states 5" in page.sections["services"]


def test_latency_of_a_fast_run_is_in_wall_time(tmp_path):
    tape = Tape(tmp_path / "fast.mcap", speed=5.0)
    tape.put(0, "pick_place_status", PickPlaceStatus())
    for k in range(3):  # exposed 20 ms of wall time before: cell time runs five times as fast
        stamp = m.Header(stamp=BEGIN + round((1 + k - 0.02) * 5e9))
        tape.put(1 + k, "validated_targets", m.PoseArray(header=stamp, poses=[]))
    assert "3 frames: median 20.0 ms" in tape.report().sections["latency"]


def test_custom_application_is_reported_with_its_own_figures(tmp_path, monkeypatch):
    (tmp_path / "own_words").mkdir()
    (tmp_path / "own_words" / "polish.py").write_text(
        "from common import messages as m\nfrom common.application import Application, ApplicationTopics\n"
        "from recording.report import application\n"
        "from common.topics import Topic\n\n"
        "class PolishStatus(m.TaskStatus):\n    pass\n\n"
        'STATUS = Topic("polish_status", PolishStatus, "state", "how smooth it is")\n\n'
        'class Figures(application.Figures):\n    COUNTED = "polished"\n\n'
        "APPLICATION = Application(topics=ApplicationTopics(status=STATUS), figures=Figures)\n"
    )
    (tmp_path / "cell.yaml").write_text(
        "cell: shop\nrobot: panda\nworld: balls\npipeline: lerp\napplication: own_words.polish\n"
        "task: trajectory_executor\nservices: {trajectory_executor: {}}\n"
    )
    monkeypatch.chdir(tmp_path)
    with own_modules(tmp_path):
        monkeypatch.syspath_prepend(tmp_path)
        status = importlib.import_module("own_words.polish").PolishStatus
        tape = Tape(tmp_path / "run.mcap", "shop")
        tape.put(1, "polish_status", status(header=tape.header(1), state="RUBBING", started=True, total=2))
        tape.put(2, "polish_status", status(
            header=tape.header(2), state="DONE", started=True, done=2, total=2, figures={"roughness_um": 0.8}))
        tape.writer.close()
        page = report(tape.path, "--cell", "cell.yaml")
    assert all(part in page.head for part in ("shop: DONE", "polished 2 of 2", "roughness_um 0.8"))
    assert "RUBBING" in page.sections["timeline"]
    page = report(tape.path)
    assert all(part in page.head for part in ("shop: DONE", "done 2 of 2", "roughness_um 0.8"))


@pytest.mark.slow
def test_recording_of_an_unknown_cell_has_no_limits_until_the_cell_is_named(tmp_path):
    tape = Tape(tmp_path / "away.mcap", "elsewhere")
    tape.put(0, "pick_place_status", PickPlaceStatus(state="ERROR", started=True, message="x"))
    tape.put(1, "joint_states", m.JointState(header=tape.header(1), name=[*ARM, "panda_finger_joint1"],
                                             position=[0.5] * 8, velocity=[0.0] * 8))
    page = tape.report()
    assert "elsewhere: ERROR" in page.head
    assert "Joint limits and the path of the tool are missing" in page.sections["summary"]
    assert page.table("joints")[0] == ["panda_joint1", "0.500", "0.500", "0.000"] and len(page.table("joints")) == 7
    page = report(tape.path, "--cell", "panda")
    assert len(page.table("joints")[0]) == 7 and "not shown" not in page.sections["summary"]


def test_truncated_recording_is_reported_up_to_its_end(tmp_path, capsys):
    tape = Tape(tmp_path / "cut.mcap")
    tape.put(0, "pick_place_status", PickPlaceStatus(state="GRASPING", started=True, targets=3))
    tape.put(2, "motion/status", m.MotionStatus(id="g", state="active"))
    tape.truncate()
    page = report(tape.path)
    (line,) = capsys.readouterr().err.splitlines()
    for text in (line, page.sections["summary"]):
        assert "is truncated" in text and "zencell recover" in text
    assert "panda: GRASPING" in page.head
    assert all(page.sections[section].strip() for section in ("plans", "latency", "joints"))


@pytest.mark.parametrize("topic", [None, "foreign/status"])
def test_recording_without_a_run_is_rejected(topic, tmp_path, rejection):
    tape = Tape(tmp_path / "run.mcap")
    if topic:
        tape.put(0, topic, PickPlaceStatus())
    tape.writer.close()
    line = rejection("report", str(tape.path))
    assert all(part in line for part in (str(tape.path), "has no messages of a run", "joint_states"))
    assert not tape.path.with_suffix(".html").exists()
