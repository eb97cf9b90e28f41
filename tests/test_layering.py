"""Rules for the source tree that import-linter (pyproject.toml) does not express."""

import ast
import importlib
import re
import subprocess
import sys
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PURE = ("robot", "scene", "planning", "perception", "tasks", "hardware", "sim")
CONTAINER_FILES = ("Dockerfile", "compose.yaml", ".dockerignore")  # with paths of the image
MACHINE_PATH = re.compile(rb"(?<![\w.])/(?:home|root|work|Users|farm)/\w")
PLATFORM = ("page", "drivers", "recording", "tools", "lab", "security", "bridges", "cli")
PLATFORM_SERVICES = (
    "motion_planner", "robot_state_publisher", "trajectory_executor", "viewer", "camera_simulator", "depth_camera",
    "camera_opencv", "real_depth_camera", "fixture_scene", "router", "foxglove_bridge", "ros2_bridge",
    "ros2_camera", "ros2_joints", "io", "arm_coordinator", "arm_tasks",
)
APPLICATIONS = [path.parent.name for path in sorted((ROOT / "applications").glob("*/__init__.py"))]
SHORT_FORMS = ("common/config/world.py",)  # of world files


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


@cache
def imports(path: Path) -> frozenset[str]:
    """Return the modules that a file imports anywhere, by absolute imports."""
    found = set[str]()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
    return frozenset(found)


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def lines_with(pattern: re.Pattern[str], paths: list[Path]) -> list[str]:
    return [f"{name_of(path)}:{number}: {line.strip()}" for path in paths
            for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1) if pattern.search(line)]


def test_layers_of_pyproject_hold() -> None:
    done = subprocess.run([sys.executable, "-c", "from importlinter.cli import lint_imports_command as run; run()"],
                          cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout


@pytest.mark.parametrize("package", PURE)
def test_pure_package_does_not_use_asyncio(package: str) -> None:
    assert [name_of(path) for path in sources(f"common/{package}") if "asyncio" in imports(path)] == []


def test_command_line_is_thin() -> None:
    lines = {name_of(path): len(path.read_text(encoding="utf-8").splitlines()) for path in sources("cli")}
    assert sum(lines.values()) < 4200, sorted(lines.items(), key=lambda item: -item[1])[:5]


def test_tests_do_not_import_benchmarks() -> None:
    assert lines_with(re.compile(r"^\s*(from|import) benchmarks\b"), sources("tests")) == []


def test_no_tracked_file_contains_a_path_of_one_machine() -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    found = []
    for name in filter(None, listed.stdout.decode().split("\0")):
        path = ROOT / name
        if name not in CONTAINER_FILES and path != Path(__file__) and path.is_file():
            data = path.read_bytes()
            if b"\0" not in data[:1024] and (match := MACHINE_PATH.search(data)):
                found.append(f"{name}: {match.group().decode()}")
    assert found == []


def of_platform() -> list[Path]:
    applications = ROOT / "applications"
    services = [ROOT / "services" / f"{name}.py" for name in PLATFORM_SERVICES]
    return [path for path in sources("common", *PLATFORM) if applications not in path.parents] + services


def imported_applications(path: Path) -> set[str]:
    return {name.split(".")[1] for name in imports(path) if name.startswith("applications.")}


def application_words() -> set[str]:
    """Return the words that only an application may use: its name, task, services, messages and keys."""
    words = {path.stem for path in sources("services") if imported_applications(path)} - set(PLATFORM_SERVICES)
    for name in APPLICATIONS:
        package = importlib.import_module(f"applications.{name}")
        keys = importlib.import_module(f"{package.__name__}.topics")
        own = list(package.APPLICATION.topics_by_key.values())
        words |= {name, package.APPLICATION.task}
        words |= {topic.key for topic in own if "_" in topic.key or "/" in topic.key}
        words |= {key for key, value in vars(keys).items() if value in own}
        words |= {key for key, value in vars(keys).items()
                  if isinstance(value, type) and value.__module__ == keys.__name__}
    return words


def test_every_service_belongs_to_the_platform_or_to_one_application() -> None:
    for path in sources("services"):
        if path.stem != "__init__" and path.stem not in PLATFORM_SERVICES:
            assert len(imported_applications(path)) == 1, f"{path.stem}"


def test_platform_uses_no_word_of_an_application() -> None:
    words = application_words()
    assert {"smart_pick_place", "contour_tracer", "vision_detector", "PickPlaceStatus", "scene_balls"} <= words
    either = "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))
    assert lines_with(re.compile(rf"(?<![\w/])(?:{either})(?![\w/])"), of_platform()) == []


def test_platform_names_no_included_robot_and_mentions_balls_only_in_short_forms() -> None:
    robots = "|".join(rf"{path.stem}(?!s)" for path in (ROOT / "config" / "robots").glob("*.yaml"))  # pandas: library
    assert "panda" in robots
    assert lines_with(re.compile(robots, re.IGNORECASE), of_platform()) == []
    others = [path for path in of_platform() if name_of(path) not in SHORT_FORMS]
    assert lines_with(re.compile("ball", re.IGNORECASE), others) == []


@pytest.mark.parametrize("code", [
    "import services.camera_simulator, common.sim.kinematic",
    "import common.supervision.supervisor, recording.report.aggregator, cli.session.session as o\n"
    "o.CellSession('panda', connect='tcp/127.0.0.1:9')",
], ids=["camera", "supervisor"])
def test_process_without_planning_imports_no_planner(code: str) -> None:
    script = f"{code}\nimport sys\nprint(*{{'pinocchio', 'coal', 'ompl', 'viser'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == ("", "")
