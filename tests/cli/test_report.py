import base64
import importlib
import re
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest

from applications.outlining.topics import OutlinePoints, OutlineStatus
from applications.pick_place.topics import PickPlaceStatus
from cli.main import app
from common import messages as m
from common.transport.codec import encode
from recording.report import clips
from recording.sample import Sample
from recording.writer import RUN, RecordingWriter

BEGIN = 1_700_000_000_000_000_000  # [ns]
ARM = [f"panda_joint{k}" for k in range(1, 8)]
UR5 = ["shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"]
KINDS = {"joint_states": "stream", "detected_objects": "stream", "validated_targets": "stream", "log": "event",
         "rejected_targets": "event", "counters": "event"}
NASTY = '<script>alert("1")</script> & $x^2$'


class Tape:
    """Writes a recording of which every number is known."""

    def __init__(self, path, cell="panda", **run):
        self.cell = cell
        self.writer = RecordingWriter(path, {"cell": cell, "versions": {"zencell": "0.1.0"}})
        self.writer.describe(RUN, {"speed": 1.0, "epoch": BEGIN, "seed": 7, "world": "", "overrides": [], **run})

    def put(self, seconds, topic, message):
        name = type(message).__name__
        self.writer.add(Sample(f"{self.cell}/{topic}", encode(message), BEGIN + round(seconds * 1e9), message=name,
                               kind=KINDS.get(topic, "state"), writer="w"))

    def header(self, seconds):
        return m.Header(stamp=BEGIN + round(seconds * 1e9), frame_id="world")


class Page(HTMLParser):
    """Sections with their text, rows of tables, and everything that a browser would ask for."""

    def __init__(self, text):
        super().__init__()
        self.sections, self.rows, self.asked, self.tags = {}, [], [], []
        self._section, self._cell = "", None
        self.feed(text)

    def handle_starttag(self, tag, attributes):
        values = dict(attributes)
        self.tags.append(tag)
        self.asked += [v for k, v in values.items() if k in ("src", "href", "xlink:href", "action") and v]
        if tag == "section":
            self._section = values["id"]
            self.sections[self._section] = ""
        elif tag == "tr":
            self.rows.append((self._section, []))
        elif tag == "td":
            self.rows[-1][1].append("")
            self._cell = self.rows[-1][1]

    def handle_endtag(self, tag):
        if tag == "td":
            self._cell = None

    def handle_data(self, data):
        if self._section:
            self.sections[self._section] += f" {data}"
        if self._cell is not None:
            self._cell[-1] += data

    def table(self, section):
        return [row for name, row in self.rows if name == section and row]


def point(x, y, z=0.03):
    return m.Vector3(x=x, y=y, z=z)


def pick_and_place(tape):
    plans = [m.PlanFigure(planner="cartesian", seconds=0.012, fraction=1.0, attempts=1),
             m.PlanFigure(planner="ompl", seconds=0.345, fraction=1.0, attempts=3)]
    ball = m.CollisionObject(id="ball_1", role="target", shape="sphere", dimensions=[0.03],
                             pose=m.Pose(position=point(0.5, 0.1)))
    table = m.CollisionObject(id="table", role="fixture", shape="box", dimensions=[1, 1, 0.05],
                              pose=m.Pose(position=point(0.5, 0, -0.025)))
    services = [m.ServiceStatus(name="vision_detector", state="ready", ready_seconds=1.25)]
    tape.put(0, "supervisor/status", m.SupervisorStatus(cell="panda", services=services))
    tape.put(0.1, "planning_scene", m.PlanningScene(header=tape.header(0.1), objects=[ball, table]))
    tape.put(0.2, "pick_place_status", PickPlaceStatus(header=tape.header(0.2), state="IDLE", targets=2))
    for k in range(100):
        t = 0.25 + 0.02 * k
        q = [0.3 * np.sin(t), 0.1, 0, -1.5, 0, 1.5, 0.2]
        dq = [0.1] * 6 + [-1.305]
        tape.put(t, "joint_states", m.JointState(header=tape.header(t), name=ARM, position=q, velocity=dq))
    for k in range(10):
        t = 0.3 + 0.1 * k
        exposed = tape.header(t - 0.001 * (k + 1))  # 1 to 10 ms old
        found = [m.Marker(ns="ball", id=0, type="sphere", pose=m.Pose(position=point(0.5, 0.1)), scale=point(1, 1, 1))]
        tape.put(t - 0.0005, "detected_objects", m.MarkerArray(header=exposed, markers=found))
        tape.put(t, "validated_targets", m.PoseArray(header=exposed, poses=[m.Pose(position=point(0.5, 0.1))]))
    tape.put(0.5, "rejected_targets", m.Rejections(
        header=tape.header(0.5), rejected=[m.Rejection(position=point(0.2, 0.0), reason=f"too near {NASTY}")]))
    for k in range(len(plans)):
        rest = {"positions": [0] * 7, "velocities": [0] * 7, "accelerations": [0] * 7}
        last = m.JointTrajectoryPoint(time_from_start=2.5 + k, **rest)
        tape.put(0.6 + k, "display_trajectory", m.JointTrajectory(joint_names=ARM, points=[last]))
        tape.put(0.65 + k, "pick_place_status", PickPlaceStatus(
            header=tape.header(0.65 + k), state="GRASPING", target="ball_1", started=True, targets=2,
            plans=plans[: k + 1], planning_seconds=sum(p.seconds for p in plans[: k + 1])))
        tape.put(0.7 + k, "motion/status", m.MotionStatus(id=f"goal_{k}", state="active"))
        tape.put(1.2 + k, "motion/status", m.MotionStatus(
            id=f"goal_{k}", state="aborted" if k else "succeeded", error="path_tolerance" if k else "",
            message="joint 3 is 0.2 rad off" if k else "", source="arm_controller"))
    tape.put(1.3, "gripper/state", m.GripperState(holding=True))
    tape.put(1.8, "gripper/state", m.GripperState(holding=False))
    services = [services[0].model_copy(update={"restarts": 1, "message": "killed by SIGKILL"})]
    tape.put(1.9, "supervisor/status", m.SupervisorStatus(cell="panda", services=services))
    tape.put(2.0, "log", m.LogLine(service="motion_planner", level="warning", message=f"no way: {NASTY}"))
    tape.put(2.0, "log", m.LogLine(service="motion_planner", level="info", message="not shown"))
    tape.put(2.1, "counters", m.ServiceCounters(service="vision_detector", dropped={"camera/image_raw": 12},
                                                invalid={"camera/image_raw": 3}, overflow={"x": 1}))
    tape.put(2.2, "scene_balls", m.PoseArray(header=tape.header(2.2), labels=["box", "table"], poses=[
        m.Pose(position=point(0.55, 0.25)), m.Pose(position=point(0.2, 0))]))
    tape.put(2.5, "pick_place_status", PickPlaceStatus(
        header=tape.header(2.5), state="DONE", started=True, placed=1, targets=2, failures=4, retries=5, plans=plans,
        moving_seconds=1.75, planning_seconds=0.357, task_seconds=2.25,
        skipped=[m.Rejection(position=point(0.3, 0.3), reason="given up after 3 tries")]))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("report") / "run.mcap"
    tape = Tape(path)
    pick_and_place(tape)
    tape.writer.close({"dropped": {"panda/joint_states": 2}, "missed": {"panda/joint_states": 3}})
    return path


@pytest.fixture(scope="module")
def page(recorded):
    output = recorded.with_name("report.html")
    assert app.execute(["report", str(recorded), "-o", str(output)]) == 0
    return Page(output.read_text(encoding="utf-8"))


def test_the_page_has_every_section_and_asks_nobody(page, recorded):
    assert list(page.sections) == [
        "summary", "timeline", "top", "plans", "latency", "joints", "problems", "services", "log"
    ]
    assert all(reference.startswith("#") for reference in page.asked)
    text = recorded.with_name("report.html").read_text()
    assert "<script" not in text and "@import" not in text and not re.search(r"url\((?!#)", text)
    assert page.tags.count("svg") == 5


def test_its_numbers_are_those_that_were_recorded(page):
    head = " ".join(page.sections["summary"].split())
    for part in ("panda: DONE", "placed 1 of 2", "rejected places 2", "truth 1 in the box, 1 on the table",
                 "moving 1.8 s", "planning 0.4 s in 2 plans", "failures, retries 4, 5", "restarts 1 x", "seed 7",
                 "2.5 s", "frame to target 5.0 ms (median)", "zencell 0.1.0"):
        assert part in head, part
    assert page.table("plans") == [["1", "0.60", "cartesian", "12.0", "1", "1.00", "2.50"],
                                   ["2", "1.60", "ompl", "345.0", "3", "1.00", "3.50"]]
    assert "10 frames: median 5.5 ms" in page.sections["latency"] and "at most 10.0 ms" in page.sections["latency"]
    assert "1 picked, 1 rejected" in page.sections["top"]


def test_joints_stand_beside_their_limits(page):
    rows = {row[0]: row for row in page.table("joints")}
    assert set(rows) == set(ARM)
    assert rows["panda_joint7"][1:] == ["0.200", "0.200", "1.305", "-2.897 to 2.897", "2.610", "50%"]
    assert float(rows["panda_joint1"][2]) == pytest.approx(0.3 * np.sin(1.5708), abs=2e-3)


def test_what_failed_is_listed_in_time_with_its_reason(page):
    assert page.table("problems") == [
        ["0.50", "rejected", "(0.200, 0.000, 0.030)", f"too near {NASTY}"],
        ["1.90", "restarted", "vision_detector", "killed by SIGKILL"],
        ["2.20", "motion aborted", "goal_1", "joint 3 is 0.2 rad off [arm_controller]"],
        ["2.50", "skipped", "(0.300, 0.300, 0.030)", "given up after 3 tries"],
    ]
    assert page.table("log") == [["2.00", "warning", "motion_planner", f"no way: {NASTY}"]]
    assert page.table("services") == [["vision_detector", "ready", "1.25", "1", "12", "3", "1"]]
    assert "joint_states 5" in page.sections["services"]


def test_a_recording_that_ran_faster_tells_latency_in_wall_time(tmp_path):
    path = tmp_path / "fast.mcap"
    tape = Tape(path, speed=5.0)
    tape.put(0, "pick_place_status", PickPlaceStatus())
    for k in range(3):  # exposed 20 ms of wall time before: cell time runs five times as fast
        stamp = m.Header(stamp=BEGIN + round((1 + k - 0.02) * 5e9))
        tape.put(1 + k, "validated_targets", m.PoseArray(header=stamp, poses=[]))
    tape.writer.close()
    assert app.execute(["report", str(path)]) == 0
    assert "3 frames: median 20.0 ms" in Page((tmp_path / "fast.html").read_text()).sections["latency"]


@pytest.mark.slow
def test_an_outline_is_compared_with_what_was_traced(tmp_path):
    path = tmp_path / "outline.mcap"
    tape = Tape(path, "ur5", world="w2")
    corners = [(0.45, -0.05), (0.55, -0.05), (0.55, 0.05), (0.45, 0.05)]
    poses = [m.Pose(position=point(x, y, 1.05)) for x, y in corners]
    tape.put(0, "outline_status", OutlineStatus(header=tape.header(0), state="PLANNING", started=True))
    tape.put(0.4, "contour_path", OutlinePoints(header=tape.header(0.1), poses=poses, object="Object_0"))
    tape.put(0.5, "scene_objects", m.WorldObjects(objects=[m.WorldObject(
        id="cube", shape="box", outline=corners, base=1.0, height=0.05)]))
    tape.put(1, "outline_status", OutlineStatus(header=tape.header(1), state="APPROACHING", started=True))
    tape.put(1.5, "outline_status", OutlineStatus(header=tape.header(1.5), state="TRACING", started=True))
    for k in range(20):
        t = 1.6 + 0.05 * k
        q = [0.01 * k, -1.5, 1.5, -1.5, -1.5, 0.0]
        tape.put(t, "joint_states", m.JointState(header=tape.header(t), name=UR5, position=q, velocity=[0.2] * 6))
    tape.put(3, "outline_status", OutlineStatus(
        header=tape.header(3), state="DONE", started=True, object="Object_0", points=4, fraction=0.75, length_m=0.4))
    tape.writer.close()
    assert app.execute(["report", str(path)]) == 0
    page = Page((tmp_path / "outline.html").read_text())
    assert "outline" in page.sections and "top" not in page.sections
    head = " ".join(page.sections["summary"].split())
    assert "outlined Object_0" in head and "of 0.400 m" in head and "world w2" in head and "from the true edge" in head
    assert "4 points of the contour" in page.sections["outline"]
    assert "1 frame: median 300.0 ms" in page.sections["latency"]


def test_an_application_of_ones_own_is_told_of_in_its_own_words(tmp_path, monkeypatch):
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
    monkeypatch.syspath_prepend(tmp_path)
    own = importlib.import_module("own_words.polish")
    tape = Tape(tmp_path / "run.mcap", "shop")
    tape.put(1, "polish_status", own.PolishStatus(header=tape.header(1), state="RUBBING", started=True, total=2))
    tape.put(2, "polish_status", own.PolishStatus(
        header=tape.header(2), state="DONE", started=True, done=2, total=2, figures={"roughness_um": 0.8}))
    tape.writer.close()
    assert app.execute(["report", "run.mcap", "--cell", "cell.yaml"]) == 0
    page = Page((tmp_path / "run.html").read_text())
    head = " ".join(page.sections["summary"].split())
    assert "shop: DONE" in head and "polished 2 of 2" in head and "roughness_um 0.8" in head
    assert "RUBBING" in page.sections["timeline"]


@pytest.mark.slow
def test_the_recording_of_a_cell_that_is_not_here_has_no_limits_and_says_so(tmp_path):
    path = tmp_path / "away.mcap"
    tape = Tape(path, "elsewhere")
    tape.put(0, "pick_place_status", PickPlaceStatus(state="ERROR", started=True, message="x"))
    tape.put(1, "joint_states", m.JointState(header=tape.header(1), name=[*ARM, "panda_finger_joint1"],
                                             position=[0.5] * 8, velocity=[0.0] * 8))
    tape.writer.close()
    assert app.execute(["report", str(path)]) == 0
    page = Page((tmp_path / "away.html").read_text())
    assert "elsewhere: ERROR" in " ".join(page.sections["summary"].split())
    assert "Joint limits and the path of the tool are missing" in page.sections["summary"]
    assert page.table("joints")[0] == ["panda_joint1", "0.500", "0.500", "0.000"] and len(page.table("joints")) == 7
    assert app.execute(["report", str(path), "--cell", "panda"]) == 0
    page = Page((tmp_path / "away.html").read_text())
    assert len(page.table("joints")[0]) == 7 and "not shown" not in page.sections["summary"]


def test_a_recording_that_was_cut_is_reported_as_far_as_it_goes(tmp_path, capsys):
    path = tmp_path / "cut.mcap"
    tape = Tape(path)
    tape.put(0, "pick_place_status", PickPlaceStatus(state="GRASPING", started=True, targets=3))
    tape.put(2, "motion/status", m.MotionStatus(id="g", state="active"))
    tape.writer.flush()
    tape.writer.abandon()
    assert app.execute(["report", str(path)]) == 0
    (line,) = capsys.readouterr().err.splitlines()
    assert "is truncated" in line and "zencell recover" in line
    page = Page((tmp_path / "cut.html").read_text())
    assert "is truncated" in page.sections["summary"] and "zencell recover" in page.sections["summary"]
    assert "panda: GRASPING" in " ".join(page.sections["summary"].split())
    for section in ("plans", "latency", "joints"):
        assert page.sections[section].strip()


@pytest.mark.parametrize(
    ("content", "code", "wanted"),
    [
        (None, 2, ["no such file"]),
        (b"", 2, ["has no messages of a run"]),
        (b"PK\x03\x04 a picture book", 2, ["is no MCAP file"]),
        ("empty", 2, ["has no messages of a run", "joint_states"]),
        ("foreign", 2, ["has no messages of a run"]),
    ],
)
def test_what_is_no_recording_of_a_run_is_one_line(content, code, wanted, tmp_path, capsys):
    path = tmp_path / "run.mcap"
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content:
        tape = Tape(path)
        if content == "foreign":
            tape.put(0, "somebody/else", PickPlaceStatus())
        tape.writer.close()
    assert app.execute(["report", str(path)]) == code
    (line,) = capsys.readouterr().err.splitlines()
    assert all(part in line for part in [str(path), *wanted]) and not (tmp_path / "run.html").exists()


@pytest.mark.parametrize(
    ("arguments", "wanted"),
    [
        (["-o", "report.pdf"], ["--output", "report.pdf", "must end in .html"]),
        (["-o", "no/where/report.html"], ["--output", "report.html", "cannot be written"]),
        (["--cell", "pnada"], ["unknown cell 'pnada'", "panda"]),
    ],
)
def test_bad_options_are_one_line(arguments, wanted, recorded, capsys, monkeypatch):
    monkeypatch.chdir(recorded.parent)
    assert app.execute(["report", str(recorded), *arguments]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert all(part in line for part in wanted)


def picture(tape, seconds, at, width=720, height=400, data=None):
    """Black, with a white square whose left edge is at a pixel."""
    pixels = np.zeros((height, width, 3), np.uint8)
    pixels[150:250, at : at + 100] = 255
    return m.Image(header=tape.header(seconds), height=height, width=width, encoding="bgr8",
                   data=pixels.tobytes() if data is None else data)


def films_of(text):
    found = []
    for address in re.findall(r'<img src="data:image/webp;base64,([^"]+)"', text):
        done, animation = cv2.imdecodeanimation(np.frombuffer(base64.b64decode(address), np.uint8))
        assert done
        found.append(animation)
    return found


def test_report_shows_what_the_camera_saw_as_something_failed(tmp_path):
    tape = Tape(tmp_path / "run.mcap")
    pick_and_place(tape)  # a motion is aborted at 2.2 s, and the failures are told at 2.5 s: one film
    for k in range(60):
        tape.put(0.1 * k, "camera/image_raw", picture(tape, 0.1 * k, 10 * k))
    tape.put(2.05, "camera/image_raw", picture(tape, 2.05, 0, data=b"few"))
    tape.put(2.15, "camera/image_raw", picture(tape, 2.15, 0, width=200))
    tape.writer.close({})
    assert app.execute(["report", str(tmp_path / "run.mcap")]) == 0
    text = (tmp_path / "run.html").read_text()
    (film,) = films_of(text)
    assert "2.20 s: motion aborted: joint 3 is 0.2 rad off" in text
    assert len(film.frames) == 22, "0.2 s apart, from 0 to 4.2 s"
    assert film.frames[0].shape[:2] == (200, 360)
    lefts = [np.flatnonzero(frame[100, :, 0] > 128)[0] for frame in film.frames]
    assert lefts == pytest.approx([10 * k for k in range(22)], abs=2)
    assert set(film.durations[:-1]) == {200}


def failures(tape, *times):
    """The task fails at these times [s]."""
    for k, at in enumerate([0, *times]):
        tape.put(at, "pick_place_status", PickPlaceStatus(header=tape.header(at), state="GRASPING", failures=k))


def test_only_pictures_that_a_film_shows_are_looked_at_and_each_film_has_the_size_of_its_own(tmp_path, monkeypatch):
    tape, looked_at = Tape(tmp_path / "cut.mcap"), []
    small = clips._scaled
    monkeypatch.setattr(clips, "_scaled", lambda message: looked_at.append(message) or small(message))
    failures(tape, 10, 50)
    for k in range(60):
        tape.put(k, "camera/image_raw", picture(tape, k, k, *((100, 80) if k < 30 else (80, 60))))
    tape.writer.flush()
    tape.writer.abandon()
    assert app.execute(["report", str(tmp_path / "cut.mcap")]) == 0
    found = films_of((tmp_path / "cut.html").read_text())
    assert [film.frames[0].shape[:2] for film in found] == [(80, 100), (60, 80), (60, 80)]
    assert len(looked_at) == 2 * 7 + 5, "from 4 s before to 2 s after, and the end of what was not over"


def test_tall_pictures_are_made_small_and_of_many_cameras_some_are_shown(tmp_path):
    tape = Tape(tmp_path / "run.mcap")
    failures(tape, 2)
    for k in range(3):
        for camera in range(clips.MOST_CAMERAS + 3):
            data = np.full((16384, 1, 3), 100 * k, np.uint8).tobytes()
            tape.put(k, f"{camera}/image_raw", picture(tape, k, 0, 1, 16384, data))
    tape.writer.close({})
    assert app.execute(["report", str(tmp_path / "run.mcap")]) == 0
    found = films_of((tmp_path / "run.html").read_text())
    assert [(len(film.frames), film.frames[0].shape[:2]) for film in found] == [(3, (480, 1))] * clips.MOST_CAMERAS


def test_what_had_gone_wrong_before_the_recording_began_has_no_film(tmp_path):
    tape = Tape(tmp_path / "run.mcap")
    for k in range(2):  # states are said again each second
        tape.put(0.1 + k, "motion/status", m.MotionStatus(id="a", state="aborted", message="of before", error="limit"))
        tape.put(0.2 + k, "pick_place_status", PickPlaceStatus(
            header=tape.header(k), state="ERROR", target="ball_0", failures=3))
    tape.put(5, "pick_place_status", PickPlaceStatus(header=tape.header(5), state="GRASPING", failures=3))
    tape.put(8, "motion/status", m.MotionStatus(id="b", state="rejected", message="of now", error="limit"))
    for k in range(100):
        tape.put(0.1 * k, "camera/image_raw", picture(tape, 0.1 * k, k))
    tape.writer.close({})
    assert app.execute(["report", str(tmp_path / "run.mcap")]) == 0
    text = (tmp_path / "run.html").read_text()
    assert re.findall(r"<figcaption[^>]*>([^(]*) \(", text) == ["8.00 s: motion rejected: of now"]


def rolls_off_the_table(tape, lost_at):
    """Two balls, of which one comes to lie on the floor while the task fails nowhere; another lay there before."""
    for t in range(30):
        states = {"ball_0": "contained", "ball_1": "table" if t < lost_at else "elsewhere", "ball_2": "elsewhere"}
        tape.put(t, "scene_objects", m.WorldObjects(objects=[
            m.WorldObject(id=name, shape="sphere", pose=m.Pose(position=point(0.9, 0.2 * k, -0.5)), state=state)
            for k, (name, state) in enumerate(states.items())]))


def test_what_comes_to_lie_on_the_floor_is_listed_and_has_a_film_before_what_was_only_tried_again(tmp_path):
    tape = Tape(tmp_path / "run.mcap")
    failures(tape, 1, 5, 10, 15)
    rolls_off_the_table(tape, 20)
    for k in range(30):
        tape.put(k, "camera/image_raw", picture(tape, k, 10 * k))
    tape.writer.close({})
    assert app.execute(["report", str(tmp_path / "run.mcap")]) == 0
    text = (tmp_path / "run.html").read_text()
    told = re.findall(r"<figcaption[^>]*>([0-9.]+ s: .*) \(camera", text)
    assert told == ["1.00 s: GRASPING", "20.00 s: ball_1 lies elsewhere, at (0.900, 0.200, -0.500)",
                    "29.00 s: it ends GRASPING"]
    page = Page(text)
    assert page.table("problems") == [
        ["20.00", "lost, by truth", "ball_1", "lies elsewhere, at (0.900, 0.200, -0.500)"]]


def test_run_that_ends_done_with_something_left_that_it_does_not_name_has_a_film_of_its_end(tmp_path):
    tape = Tape(tmp_path / "run.mcap")
    tape.put(0, "pick_place_status", PickPlaceStatus(header=tape.header(0), state="GRASPING", started=True))
    tape.put(0, "scene_objects", m.WorldObjects(objects=[m.WorldObject(
        id="ball_0", shape="sphere", pose=m.Pose(position=point(0.5, 0.2)), state="table")]))
    tape.put(8, "pick_place_status", PickPlaceStatus(header=tape.header(8), state="DONE", started=True))
    for k in range(10):
        tape.put(k, "camera/image_raw", picture(tape, k, 10 * k))
    tape.writer.close({})
    assert app.execute(["report", str(tmp_path / "run.mcap")]) == 0
    text = (tmp_path / "run.html").read_text()
    assert len(films_of(text)) == 1
    assert "8.00 s: DONE but left at (0.500, 0.200, 0.030): not rejected by the task" in text


@pytest.mark.parametrize("state", ["PLACING", "IDLE"])
def test_run_that_is_not_over_when_it_ends_has_a_film_of_how_it_stood(tmp_path, state):
    tape = Tape(tmp_path / "run.mcap")
    for t, label in ((0, "IDLE"), (1, "GRASPING"), (8, state)):
        tape.put(t, "pick_place_status", PickPlaceStatus(header=tape.header(t), state=label, started=True))
    for k in range(10):
        tape.put(k, "camera/image_raw", picture(tape, k, 10 * k))
    tape.writer.close({})
    assert app.execute(["report", str(tmp_path / "run.mcap")]) == 0
    text = (tmp_path / "run.html").read_text()
    assert re.findall(r"<figcaption[^>]*>([^(]*) \(", text) == [f"9.00 s: it ends {state}"]


def test_report_of_a_run_without_failures_or_pictures_has_no_film(recorded, tmp_path):
    tape = Tape(tmp_path / "well.mcap")
    tape.put(0, "pick_place_status", PickPlaceStatus(header=tape.header(0), state="IDLE"))
    for k in range(10):
        tape.put(0.1 * k, "camera/image_raw", picture(tape, 0.1 * k, 0))
    tape.writer.close({})
    for path in (tmp_path / "well.mcap", recorded):
        assert app.execute(["report", str(path), "-o", str(tmp_path / "page.html")]) == 0
        assert not films_of((tmp_path / "page.html").read_text())
