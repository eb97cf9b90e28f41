"""docs/extending.md: its files in a separate folder, and its commands, with real processes."""

import csv
import importlib
import json
import os
import re
import shlex
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import viser
import yaml

from common import messages as m
from common.application import find_application
from common.config import load_cell, service_config
from common.errors import ConfigError
from common.hardware.backends import load_hardware
from common.hardware.interface import Limits
from common.planning.planners import load_planner
from common.process.in_process import running_service
from common.robot.model import RobotModel
from common.supervision.wiring import wiring
from common.tasks.stages import View
from common.topics import CAMERA_IMAGE, CAMERA_INFO, GRIPPER_STATE, SCENE_OBJECTS
from common.transport.codec import decode
from common.transport.local import LocalNetwork
from lab.simulation import Simulation
from page.server import close_server, make_server
from recording.reader import Recording
from tests import pages
from tests.harness import ask, free_domain
from tests.page.scene_cell import Stage
from tests.simulated.visited import no_processes

ROOT = Path(__file__).resolve().parent.parent
BIN = Path(sys.executable).parent
PAGE = (ROOT / "docs" / "extending.md").read_text(encoding="utf-8")
FILES = pages.files(PAGE)
COMMANDS = [
    line for block in re.findall(r"^```sh\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE) for line in block.splitlines()
]
HERE = [line for line in COMMANDS if re.match(r"zencell run (?!cube)", line)]
ANYWHERE, = (line for line in COMMANDS if re.match(r"PYTHONPATH=\S+ zencell run ", line))
CUBE = next(line for line in COMMANDS if line.startswith("zencell run cube.yaml"))
TIMEOUT = 60  # [s]
DONE = "DONE, 1 of 1 placed (truth: 1 in the box, 0 on the table)"


def environment(**more: str) -> dict[str, str]:
    inherited = {name: value for name, value in os.environ.items() if not name.startswith(("ZENCELL_", "PYTHONPATH"))}
    return {**inherited, "PATH": f"{BIN}:{os.environ['PATH']}", "ZENCELL_DOMAIN": str(free_domain()), **more}


def run_command(line: str, folder: Path, **more: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(shlex.split(line), cwd=folder, env=environment(**more), text=True, capture_output=True,
                          timeout=TIMEOUT, check=False)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The folder that the page builds, with what its commands make in it; its modules can be imported here too."""
    folder = tmp_path_factory.mktemp("outside") / "my_cell"
    for name, text in FILES.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text, encoding="utf-8")
    for line in COMMANDS:
        if line.startswith(("xacro ", "zencell robot ")):
            made = run_command(line, folder)
            assert made.returncode == 0, made.stderr
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(folder)
        yield folder
    for name in [name for name in sys.modules if name.partition(".")[0] == "my_pkg"]:
        del sys.modules[name]


def test_page_lists_every_file() -> None:
    listed = re.search(r"^```\nmy_cell/\n(.*?)^```$", PAGE, re.DOTALL | re.MULTILINE)
    assert set(re.findall(r"[\w.]+\.\w+", listed[1])) == {Path(name).name for name in FILES}
    assert len(HERE) == 2


def test_robot_has_the_links_of_arm_and_gripper(folder: Path) -> None:
    cell = load_cell(str(folder / "my_cell.yaml"))
    robot = RobotModel.load(cell.robot)
    assert {"tool0", "palm", "left_finger", "my_tcp"} <= set(robot.link_names)
    T_tool_tcp = np.linalg.inv(robot.link_poses(robot.named("home"))["tool0"]) @ robot.fk(robot.named("home"))
    assert T_tool_tcp[:3, 3] == pytest.approx([0, 0, 0.1])
    srdf = (folder / "my_robot.srdf").read_text(encoding="utf-8")
    assert 'link1="palm" link2="left_finger"' in srdf and 'link1="forearm_link" link2="palm"' not in srdf


@pytest.mark.slow
def test_suction_cup_places_every_ball(folder: Path) -> None:
    urdf, sections = (text for _, text in pages.blocks(PAGE.partition("### A suction cup")[2])[:2])
    (folder / "my_cup.urdf").write_text(urdf, encoding="utf-8")
    robot = yaml.safe_load(FILES["my_robot.yaml"]) | yaml.safe_load(sections) | {"srdf": "cup.srdf"}
    (folder / "cup.yaml").write_text(yaml.safe_dump(robot), encoding="utf-8")
    assert run_command("zencell robot collisions cup.yaml -o cup.srdf", folder).returncode == 0
    outcome = Simulation(load_cell("panda", ["world.count=2", f"robot={folder / 'cup.yaml'}"]), 1).run()
    assert (outcome.state, outcome.done, outcome.broken) == ("DONE", 2, [])


def test_custom_hardware_reads_in_encoder_steps(folder: Path) -> None:
    options = ["robot.hardware.backend=my_pkg.encoder_arm", "robot.hardware.options.resolution=0.01"]
    config = load_cell("panda", options).robot
    robot = RobotModel.load(config)
    limits = Limits(tuple(robot.joint_names), robot.lower, robot.upper, robot.velocity, robot.acceleration)
    hardware = load_hardware(config, limits, robot.named("home"))
    q = robot.named("home") + 0.013
    hardware.write(q, 0 * q, 0.1)
    read, _ = hardware.read(0.1)
    assert read == pytest.approx(np.round(q / 0.01) * 0.01) and abs(read - q).max() > 1e-4
    too_coarse = load_cell("panda", [*options, "robot.hardware.options.resolution=1"]).robot
    with pytest.raises(ConfigError, match=r"robot\.hardware\.options\.resolution: 1 "):
        load_hardware(too_coarse, limits, q)


def test_custom_planner_options_are_validated(folder: Path) -> None:
    with pytest.raises(ConfigError, match=r"my_pkg\.over_home\.goals: 0 must be greater than or equal to 1"):
        load_planner("my_pkg.over_home", {"goals": 0})
    with pytest.raises(ConfigError, match=r"my_pkg\.my_topics.*must have plan\(\)"):
        load_planner("my_pkg.my_topics", {})


async def test_custom_services_have_the_documented_wiring_and_parameters(folder: Path) -> None:
    cell = load_cell(str(folder / "my_cell.yaml"))
    keys = {}
    for name in ("evening_camera", "nearest_target"):
        module = importlib.import_module(f"my_pkg.{name}")
        wired = await wiring(module.run, service_config(cell, name, module.Config))
        keys[name] = {t.key for t in wired.reads}, {t.key for t in wired.writes}
    assert keys["evening_camera"] == ({"scene_objects"}, {"camera/image_raw", "camera/camera_info"})
    assert keys["nearest_target"] == ({"validated_targets"}, {"nearest_target"})
    dark = load_cell(str(folder / "my_cell.yaml"), ["services.evening_camera.blue=0"])
    with pytest.raises(ConfigError, match=r"services\.evening_camera\.blue: 0 must be greater than 0"):
        service_config(dark, "evening_camera", importlib.import_module("my_pkg.evening_camera").Config)


async def test_custom_camera_sends_images_with_less_blue(folder: Path) -> None:
    module = importlib.import_module("my_pkg.evening_camera")
    cell = load_cell(str(folder / "my_cell.yaml"), ["services.evening_camera.blue=0.5"])
    net = LocalNetwork()
    bus = net.bus()
    images, infos = bus.reader(CAMERA_IMAGE), bus.reader(CAMERA_INFO)
    async with running_service(net, module.run, service_config(cell, "evening_camera", module.Config)):
        bus.writer(SCENE_OBJECTS).put(m.WorldObjects(header=bus.header("world")))
        image, info = await images.next(), await infos.next()
    picture = np.frombuffer(image.data, np.uint8).reshape(image.height, image.width, 3)
    assert (info.width, info.height) == (image.width, image.height)
    assert tuple(picture[1, 1]) == (64, 128, 128)


def planners(summary: Path) -> set[str]:
    return {plan["planner"] for plan in json.loads(summary.read_text(encoding="utf-8"))["plans"]}


@pytest.mark.parametrize("line", HERE)
@pytest.mark.slow
def test_project_cell_runs_with_one_custom_part(line: str, folder: Path, tmp_path: Path) -> None:
    file = tmp_path / "summary.json"
    with no_processes():
        ran = ask(folder, *shlex.split(line)[1:], "--set", "world.count=1", "--summary", str(file), "--domain",
                  str(free_domain()))
    assert ran.returncode == 0 and DONE in ran.stdout, ran.stdout + ran.stderr
    assert ("over_home" in planners(file)) == ("my_pipeline" in line)


@pytest.mark.slow
@pytest.mark.cell
def test_custom_cell_runs_from_any_folder(folder: Path, tmp_path: Path) -> None:
    variable, line = ANYWHERE.replace("~/my_cell", str(folder)).split(" ", 1)
    name, _, path = variable.partition("=")
    file = tmp_path / "summary.json"
    ran = run_command(f"{line} --speed 10 --set world.count=1 --summary {file}", tmp_path, **{name: path})
    assert ran.returncode == 0 and DONE in ran.stdout, ran.stdout + ran.stderr
    services = [name.rpartition(".")[2] for name in yaml.safe_load(FILES["my_cell.yaml"])["services"]]
    assert {"evening_camera", "nearest_target"} <= set(services)
    summary = json.loads(file.read_text(encoding="utf-8"))
    assert (summary["cell"], summary["restarts"]) == ("mine", dict.fromkeys(["router", *services], 0))
    assert "over_home" in planners(file)


def start(line: str, folder: Path, env: dict[str, str]) -> subprocess.Popen[str]:
    return subprocess.Popen(shlex.split(line), cwd=folder, env=env, text=True, stdout=subprocess.PIPE,
                            stderr=subprocess.PIPE)


@pytest.mark.slow
@pytest.mark.cell
def test_custom_service_joins_a_cell(folder: Path) -> None:
    up, join, echo = COMMANDS[COMMANDS.index("zencell up panda"):][:3]
    env = environment()
    with start(f"{up} --no-viewer", folder, env) as cell:
        while "is up at" not in (output := cell.stdout.readline()):
            assert output, "the cell did not come up"
        with start(join, folder, env) as service:
            while "panda/nearest_target" not in run_command("zencell node list", folder, **env).stdout:
                assert service.poll() is None, service.communicate()
            while run_command(echo, folder, **env).returncode:  # until its first message
                assert service.poll() is None, service.communicate()
            commands = [start(line, folder, env) for line in (
                echo, "zencell topic hz nearest_target -n 1", "zencell topic echo neerest_target")]
            shown, rate, slip = (command.communicate(timeout=TIMEOUT) for command in commands)
            service.send_signal(signal.SIGINT)
            service.communicate(timeout=TIMEOUT)
        cell.send_signal(signal.SIGINT)
        cell.communicate(timeout=TIMEOUT)
    value = json.loads(shown[0])
    assert value["distance"] > 0.2 and set(value) == {"header", "position", "distance"} and not shown[1]
    assert " Hz, " in rate[0] and not rate[1]
    assert "unknown key 'neerest_target'" in slip[1] and "no message on panda/neerest_target within 2 s" in slip[1]
    assert [command.returncode for command in commands] == [0, 0, 2]
    assert (service.returncode, cell.returncode) == (0, 0)


@pytest.mark.slow
def test_single_file_task_moves_a_cube_with_its_own_status_and_figures(folder: Path, tmp_path: Path) -> None:
    assert len(FILES["my_pkg/move_cube.py"].splitlines()) < 120
    file, recording, html = tmp_path / "summary.json", tmp_path / "run.mcap", tmp_path / "run.html"
    with no_processes():
        ran = ask(folder, *shlex.split(CUBE)[1:], "--summary", str(file), "--domain", str(free_domain()))
    assert ran.returncode == 0 and "off_mm" in ran.stdout, ran.stdout + ran.stderr
    summary = json.loads(file.read_text(encoding="utf-8"))
    assert (summary["state"], summary["placed"], summary["targets"], summary["failures"]) == ("DONE", 1, 1, 0)
    assert set(summary["figures"]) == {"off_mm"} and summary["figures"]["off_mm"] < 5
    line = next(line for line in COMMANDS if line.startswith("zencell simulate cube"))
    places = shlex.split(CUBE)[3:]  # of the same run
    simulated = ask(folder, *shlex.split(line)[1:], *places, "--trace", str(recording))
    assert simulated.returncode == 0 and "seed 1: DONE" in simulated.stdout, simulated.stdout + simulated.stderr
    with Recording(recording) as recorded:
        states = list(recorded.samples(lambda topic: topic == "move_cube_status"))
        worlds = list(recorded.samples(lambda topic: topic == "scene_objects"))
    assert {(sample.kind, json.loads(sample.schema)["title"]) for sample in states} == {("state", "MoveCubeStatus")}
    status = decode(m.TaskStatus, states[-1].payload)
    assert (status.state, status.figures) == ("DONE", summary["figures"])
    place = decode(m.WorldObjects, worlds[-1].payload).objects[0].pose.position
    assert (place.x, place.y) == pytest.approx((0.52, 0.1), abs=0.005)
    exported = run_command(f"zencell export {recording} --csv tables --topics move_cube_status", tmp_path)
    assert exported.returncode == 0 and not exported.stderr, "without the module of the task"
    rows = list(csv.DictReader((tmp_path / "tables" / "move_cube_status.csv").read_text().splitlines()))
    assert (len(rows), rows[-1]["state"]) == (len(states), "DONE")
    assert float(rows[-1]["figures.off_mm"]) == summary["figures"]["off_mm"]
    reported = ask(folder, "report", str(recording), "--cell", "cube.yaml", "-o", str(html))
    assert reported.returncode == 0 and "off_mm" in html.read_text(encoding="utf-8")


@pytest.mark.slow
def test_new_task_runs_unchanged(tmp_path: Path) -> None:
    new, = (line for line in COMMANDS if line.startswith("zencell new"))
    made = ask(tmp_path, *shlex.split(new)[1:])
    assert (made.returncode, made.stderr) == (0, "")
    simulate, = (line for line in COMMANDS if line.startswith("zencell simulate my_task"))
    simulated = ask(tmp_path, *shlex.split(simulate.replace("1-3", "1"))[1:])
    assert simulated.returncode == 0 and "1 of 1 (100.0%)" in simulated.stdout, simulated.stdout + simulated.stderr


def test_single_file_task_continues_with_a_held_object(folder: Path) -> None:
    cell = load_cell(str(folder / "cube.yaml"))
    module = importlib.import_module("my_pkg.move_cube")
    config = service_config(cell, "move_cube", module.Config)
    task = module.MoveCube(config, module.MoveCubeStatus(), "t")
    held = m.GripperState(holding=True, width=0.05)
    view = View(1.0, m.PlanningScene(header=m.Header()), held, m.MotionStatus(), [0.0] * 6, m.Pose())
    (plan,) = task.step(view)
    assert (plan.stage, plan.release) == ("across", False)
    assert (plan.goal.pose.position.x, plan.goal.pose.position.y) == config.to


def test_invalid_application_module_is_rejected_by_name(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(folder)
    with pytest.raises(ConfigError, match=r"'my_pkg\.move_ball' is not a module: there is no move_ball in .*my_pkg,"):
        load_cell("cube.yaml", ["application=my_pkg.move_ball"])
    with pytest.raises(ConfigError, match="is no application: the module has no APPLICATION"):
        find_application("my_pkg.over_home")


def test_custom_layer_is_drawn_on_the_page(folder: Path) -> None:
    server = make_server("127.0.0.1", 0)
    try:
        stage = Stage(server, "panda", custom=["my_pkg.hand_width"])
        stage.say(GRIPPER_STATE, m.GripperState(width=0.04))
        label = server.scene.get_handle_by_name("/my_pkg.hand_width/words")
        assert isinstance(label, viser.LabelHandle) and label.text == "40 mm"
        tool = stage.robot.fk(stage.robot.named("home"))
        np.testing.assert_allclose(label.position, tool[:3, 3], atol=1e-6)
    finally:
        close_server(server)


def test_unknown_service_module_is_rejected_by_name(folder: Path) -> None:
    result = ask(folder, "service", "my_pkg.farthest_target", "--cell", "panda")
    assert result.returncode == 2 and result.stderr.count("\n") == 1
    assert "'my_pkg.farthest_target' is not a module: there is no farthest_target in " in result.stderr
