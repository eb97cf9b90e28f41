"""Build and install the wheel, run cells from it, and check where every process loads its modules from."""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
from dataclasses import dataclass, replace
from pathlib import Path

import pytest

from tests.domains import free_domain

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ("common", "services", "cli", "zencell", "applications", "page", "drivers", "recording", "tools", "lab",
           "security", "bridges")
KERNEL = Path("common", "planning", "kernel")

pytestmark = pytest.mark.timeout(300)

# A sitecustomize module on PYTHONPATH: each process writes its loaded modules to a file at its end.
PROBE = """
import atexit, json, os, sys
at_once = os._exit
def report():
    main = sys.modules.get("__main__")
    loaded = [[name, module.__file__, id(module)] for name, module in list(sys.modules.items())
              if isinstance(getattr(module, "__file__", None), str)]
    path = os.path.join(os.environ["PROBE"], f"{os.getpid()}.json")
    with open(path + ".part", "w") as file:  # a process that is killed meanwhile leaves no file
        json.dump({"main": str(getattr(getattr(main, "__spec__", None), "name", None)), "loaded": loaded}, file)
    os.replace(path + ".part", path)
def leave(code):
    report()
    at_once(code)
os._exit = leave
atexit.register(report)
"""
# Which kernel the doctor reports, and which planner plans around a wall.
PLAN = """
import zencell
from tools.doctor.examination import kernel
from common.config import load_cell
from common.messages import CollisionObject, Header, JointGoal, PlanningScene, PlanRequest, Pose, Vector3
from common.planning.pipeline import PlanningPipeline
from common.planning.ik import solve_ik
from common.robot.model import RobotModel
from common.robot.transforms import tool_down

cell = load_cell("panda")
robot = RobotModel.load(cell.robot)
left, right = (solve_ik(robot, tool_down(0.5, y, 0.2), robot.named("home")).tolist() for y in (0.3, -0.3))
wall = CollisionObject(id="wall", role="fixture", shape="box", dimensions=[0.5, 0.02, 0.4],
                       pose=Pose(position=Vector3(x=0.55, y=0.0, z=0.2)))
request = PlanRequest(id="1", start=left, goal=JointGoal(positions=right), planning_attempts=1)
scene = PlanningScene(header=Header(frame_id="world"), objects=[wall])
print(kernel().level, kernel().what, PlanningPipeline(robot, cell.motion, cell.pipeline).plan(request, scene).planner)
"""
CODECS = """
from importlib.metadata import entry_points
for kind in ("decoders", "encoders"):
    found, = entry_points(group=f"zenoh_cli.codecs.{kind}", name="msgpack")
    print(found.load().__name__)
"""


@dataclass(frozen=True)
class Installation:
    """A `zencell` command and the folder of its modules."""

    command: list[str]
    modules: Path
    site: Path | None = None  # site-packages of a wheel
    file: str = ""  # name of the wheel

    def run(self, folder: Path, *arguments: str, **environment: str) -> str:
        """Run a command in a folder; return its output."""
        inherited = {k: v for k, v in os.environ.items() if not k.startswith(("ZENCELL_", "PYTHON", "VIRTUAL_ENV"))}
        done = subprocess.run([*self.command, *arguments], cwd=folder, env=inherited | environment, text=True,
                              timeout=100, capture_output=True, check=False)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout

    def python(self, folder: Path, *arguments: str) -> str:
        """Return the output of its Python, run in a folder."""
        return replace(self, command=[str(Path(self.command[0]).with_name("python"))]).run(folder, *arguments)


CLONE = Installation([sys.executable, "-m", "zencell"], ROOT)


def installed(folder: Path, compiler: bool) -> Installation:
    """Install the wheel that pip builds from the tracked files, without a compiler except the build's own, if any."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    for name in filter(None, listed.stdout.decode().split("\0")):
        (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, folder / "source" / name)
    if not compiler:
        project = folder / "source" / "pyproject.toml"
        lines = project.read_text(encoding="utf-8").splitlines(keepends=True)
        project.write_text("".join(line for line in lines if '"ziglang' not in line), encoding="utf-8")
    bare = folder / "bare"
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", bare], check=True)
    site, = bare.glob("lib/python*/site-packages")
    pip = [sys.executable, "-m", "pip", "--python", bare / "bin" / "python", "--quiet", "--disable-pip-version-check"]
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "CC")}
    environment["PATH"] = str(bare / "bin")
    subprocess.run([*pip, "wheel", "./source", "--no-deps", "-w", "dist"], cwd=folder, env=environment, check=True)
    made, = (folder / "dist").iterdir()
    subprocess.run([*pip, "install", "--no-deps", made], cwd=folder, env=environment, check=True)
    added = {path.name for path in site.iterdir()}
    assert {name.partition("-")[0] for name in added} == {"zencell"} and len(added) == 2, added
    # Use the dependencies installed here, but not their .pth files (an editable installation of the clone).
    here = [path for path in sys.path if Path(path).name == "site-packages"]
    (site / "dependencies.pth").write_text("\n".join(here) + "\n", encoding="utf-8")
    return Installation([str(bare / "bin" / "zencell")], site / "zencell" / "top-level", site, made.name)


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Installation:
    """The installed wheel, without access to the clone."""
    return installed(tmp_path_factory.mktemp("wheel"), compiler=True)


def watched(folder: Path) -> dict[str, str]:
    """Return an environment in which every process writes its modules to a folder."""
    (folder / "probe").mkdir()
    (folder / "probe" / "sitecustomize.py").write_text(PROBE, encoding="utf-8")
    return {"PYTHONPATH": str(folder / "probe"), "PROBE": str(folder / "probe")}


def mains(folder: Path, installation: Installation) -> set[str]:
    """Return the modules that ran as programs; check that none was loaded twice or from elsewhere."""
    packages = {name: installation.modules / name for name in FOLDERS}
    if installation.site:
        packages["zencell"] = installation.site / "zencell"
    found = set()
    for path in (folder / "probe").glob("*.json"):
        report = json.loads(path.read_text(encoding="utf-8"))
        ours: dict[str, dict[int, str]] = {}
        for name, file, number in report["loaded"]:
            package = packages.get(name.partition(".")[0])
            assert package is None or Path(file).is_relative_to(package), f"{name} is {file}"
            if any(Path(file).is_relative_to(package) for package in packages.values()):
                ours.setdefault(os.path.realpath(file), {})[number] = name
        assert len(ours) > 5, f"{path.name} lists no modules"
        assert [list(names.values()) for names in ours.values() if len(names) > 1] == [], report["main"]
        found.add(report["main"])
    return found


@pytest.mark.parametrize("arguments", [
    ("-m", "zencell", "cells"), ("-m", "cli.main", "cells"), ("-m", "services.workspace_validator", "--help"),
], ids=lambda arguments: arguments[1])
def test_processes_of_the_clone_load_no_module_twice(tmp_path: Path, arguments: tuple[str, ...]) -> None:
    Installation([sys.executable], ROOT).run(ROOT, *arguments, **watched(tmp_path))
    assert len(mains(tmp_path, CLONE)) == 1


@pytest.mark.slow
@pytest.mark.parametrize("kind", [pytest.param("clone", marks=pytest.mark.campaign), "wheel"])
def test_cell_runs_from_an_empty_folder_without_loading_a_module_twice(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    installation = CLONE if kind == "clone" else request.getfixturevalue("wheel")
    empty = tmp_path / "empty"
    empty.mkdir()
    environment = watched(tmp_path)
    if kind == "clone":
        environment["PYTHONPATH"] += f":{ROOT}"
    else:
        assert "panda" in installation.run(empty, "cells")
    output = installation.run(empty, "run", "panda", "--no-viewer", "--speed", "10", "--set", "world.count=1",
                              "--domain", str(free_domain()), "--record", str(tmp_path / "run.mcap"), **environment)
    assert "DONE, 1 of 1 placed" in output
    assert list(empty.iterdir()) == []
    programs = mains(tmp_path, installation)
    assert {"services.router", "services.motion_planner", "services.trajectory_executor", "cli.main"} <= programs
    assert len(programs) >= 11, programs  # command (supervisor), recorder, router, eight services


@pytest.mark.slow
def test_new_project_and_user_scripts_run_from_a_wheel(wheel: Installation, tmp_path: Path) -> None:
    wheel.run(tmp_path, "new", "fresh", "--task", "stack_cubes")
    output = wheel.run(tmp_path, "run", "fresh/cell.yaml", "--no-viewer", "--speed", "4", "--domain",
                       str(free_domain()), **watched(tmp_path))  # at speed 10 pictures are late on a busy machine
    assert "DONE" in output and "fresh.task" in mains(tmp_path, wheel)
    script = "import zencell\nfrom common.config import load_cell\nprint(load_cell('ur5').name)\n"
    assert wheel.python(tmp_path, "-c", script) == "ur5\n"


@pytest.mark.slow
def test_wheel_contains_the_kernel_the_scorer_and_the_codec_of_zenoh_cli(wheel: Installation, tmp_path: Path) -> None:
    assert wheel.file.endswith(f"-py3-none-{sysconfig.get_platform().replace('-', '_')}.whl")
    assert list((wheel.modules / KERNEL).glob("*.so"))
    assert (wheel.modules / "applications" / "sorting" / "data" / "scorer.onnx").is_file()
    output = wheel.python(tmp_path, "-c", PLAN)
    assert output.startswith("ok planning kernel: planning_kernel") and output.endswith(" rrt_connect\n")
    assert wheel.python(tmp_path, "-c", CODECS).split() == ["decode", "encode"]


@pytest.mark.slow
def test_wheel_built_without_a_compiler_plans_without_the_kernel_and_reports_it(tmp_path: Path) -> None:
    wheel = installed(tmp_path, compiler=False)
    assert wheel.file.endswith("-py3-none-any.whl")
    assert list((wheel.modules / KERNEL).glob("*.so")) == []
    output = wheel.python(tmp_path, "-c", PLAN)
    assert output.startswith("warn the planning kernel is not compiled") and output.endswith(" ompl\n")
