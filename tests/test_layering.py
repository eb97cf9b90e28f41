"""Who may import whom, held by walking the syntax trees; and what no tracked file may contain."""

import ast
import importlib
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
ABOVE_COMMON = (
    "applications", "page", "drivers", "recording", "tools", "lab", "security", "services", "cli", "zencell",
)
# What each folder above common may import besides common and itself.
PEERS = {
    "applications": {"page", "recording", "tools"},  # its labels and layers, figures, checks: parts others find by name
    "drivers": set(),
    "lab": {"drivers", "recording", "tools"},
    "page": {"recording", "security", "tools"},
    "recording": set(),
    "security": set(),
    "tools": set(),
    "services": {"applications", "page", "security", "tools"},
}
PURE = ("robot", "scene", "planning", "perception", "tasks", "hardware", "sim")
NOT_PURE = ("asyncio", "zenoh", "common.topics", "common.transport", "common.supervision", "services", "cli")
CONTAINER_FILES = ("Dockerfile", "compose.yaml", ".dockerignore")
MACHINE_PATH = re.compile(rb"(?<![\w.])/(?:home|root|work|Users|farm)/\w")


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


@cache
def imports(path: Path) -> tuple[tuple[str, int], ...]:
    """Dotted names that a file imports anywhere, each with its line; `from a import b` gives a and a.b."""
    return tuple(_imports(path))


def _imports(path: Path) -> Iterator[tuple[str, int]]:
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"), str(path))):
        if isinstance(node, ast.Import):
            for alias in node.names:
                yield alias.name, node.lineno
        elif isinstance(node, ast.ImportFrom):
            package = ".".join(path.relative_to(ROOT).parts[:-1][: None if node.level < 2 else 1 - node.level])
            module = ".".join(part for part in (package if node.level else "", node.module or "") if part)
            yield module, node.lineno
            for alias in node.names:
                yield f"{module}.{alias.name}", node.lineno


def offences(paths: list[Path], forbidden: tuple[str, ...]) -> list[str]:
    return [
        f"{path.relative_to(ROOT)}:{line} imports {name}"
        for path in paths
        for name, line in imports(path)
        if any(name == prefix or name.startswith(prefix + ".") for prefix in forbidden)
    ]


def test_services_never_import_services() -> None:
    assert offences(sources("services"), ("services", "cli")) == []


def test_common_imports_no_folder_above_it() -> None:
    assert offences(sources("common"), ABOVE_COMMON) == []


@pytest.mark.parametrize("folder", PEERS)
def test_folder_imports_only_its_peers(folder: str) -> None:
    others = tuple(name for name in ABOVE_COMMON if name not in PEERS[folder] | {folder})
    assert offences(sources(folder), others) == []


def test_the_command_line_is_thin() -> None:
    """What is not options and printing lies in common; a verb has some lines over it."""
    lines = {name_of(path): len(path.read_text(encoding="utf-8").splitlines()) for path in sources("cli")}
    assert sum(lines.values()) < 4200, sorted(lines.items(), key=lambda item: -item[1])[:5]


def test_tests_do_not_import_benchmarks() -> None:
    assert offences(sources("tests"), ("benchmarks",)) == []


def test_only_the_transport_imports_zenoh() -> None:
    transport = ROOT / "common" / "transport"
    others = [path for path in sources("common", *ABOVE_COMMON) if transport not in path.parents]
    assert offences(others, ("zenoh",)) == []


@pytest.mark.parametrize("package", PURE)
def test_pure_packages_know_nothing_of_the_network(package: str) -> None:
    found = sources(f"common/{package}")
    assert found, f"common/{package} has no files"
    assert offences(found, NOT_PURE) == []


def test_relative_and_nested_imports_are_seen(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(f"{__name__}.ROOT", tmp_path)
    folder = tmp_path / "common" / "robot"
    folder.mkdir(parents=True)
    (folder / "a.py").write_text("def f():\n    import zenoh.ext\nfrom ..transport import bus\nfrom . import ik\n")
    found = {name for name, _ in imports(folder / "a.py")}
    assert {"zenoh.ext", "common.transport", "common.transport.bus", "common.robot.ik"} <= found
    assert len(offences([folder / "a.py"], NOT_PURE)) == 3


def test_no_tracked_file_holds_a_path_of_one_machine() -> None:
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, check=False)
    if listed.returncode:
        pytest.skip("not a git checkout")
    found = []
    for name in listed.stdout.decode().split("\0"):
        path = ROOT / name
        if name in CONTAINER_FILES:  # paths in there are the image's own
            continue
        if name and path != Path(__file__) and path.is_file():
            data = path.read_bytes()
            if b"\0" not in data[:1024] and (match := MACHINE_PATH.search(data)):
                found.append(f"{name}: {match.group().decode()}")
    assert found == []


# --- the platform knows no application ----------------------------------------------------------------------------

PLATFORM = ("page", "drivers", "recording", "tools", "lab", "security", "cli")
PLATFORM_SERVICES = (
    "motion_planner", "robot_state_publisher", "trajectory_executor", "viewer", "camera_simulator", "depth_camera",
    "camera_opencv", "real_depth_camera", "router",
)
APPLICATIONS = [path.parent.name for path in sorted((ROOT / "applications").glob("*/__init__.py"))]
SHORT_FORMS = (  # where the fields of older world files are read, and the arguments of an older function
    "common/config/short_forms.py",
)


def of_platform() -> list[Path]:
    applications = ROOT / "applications"
    services = [ROOT / "services" / f"{name}.py" for name in PLATFORM_SERVICES]
    return [path for path in sources("common", *PLATFORM) if applications not in path.parents] + services


def name_of(path: Path) -> str:
    return path.relative_to(ROOT).as_posix()


def imported_applications(path: Path) -> set[str]:
    parts = [name.split(".") for name, _ in imports(path) if name.startswith("applications.")]
    return {part[1] for part in parts}


def application_words() -> set[str]:
    """What only an application may say: its name, task, services, messages and keys."""
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


def lines_with(pattern: re.Pattern[str], paths: list[Path]) -> list[str]:
    return [
        f"{name_of(path)}:{number}: {line.strip()}"
        for path in paths
        for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), 1)
        if pattern.search(line)
    ]


def test_every_service_is_the_platforms_or_belongs_to_one_application() -> None:
    for path in sources("services"):
        if path.stem != "__init__" and path.stem not in PLATFORM_SERVICES:
            assert len(imported_applications(path)) == 1, f"{path.stem}: of which application?"


def test_the_platform_never_imports_an_application() -> None:
    assert offences(of_platform(), tuple(f"applications.{name}" for name in APPLICATIONS)) == []


def test_an_application_never_imports_another() -> None:
    for name in APPLICATIONS:
        for path in sources(f"applications/{name}"):
            assert imported_applications(path) <= {name}, name_of(path)


def test_the_platform_names_no_application_and_none_of_its_words() -> None:
    words = application_words()
    assert {"smart_pick_place", "contour_tracer", "vision_detector", "PickPlaceStatus", "scene_balls"} <= words
    either = "|".join(re.escape(word) for word in sorted(words, key=len, reverse=True))
    assert lines_with(re.compile(rf"(?<![\w/])(?:{either})(?![\w/])"), of_platform()) == []


def test_the_platform_names_no_robot_that_comes_with_the_project() -> None:
    robots = "|".join(path.stem for path in (ROOT / "config" / "robots").glob("*.yaml"))
    assert "panda" in robots
    assert lines_with(re.compile(robots, re.IGNORECASE), of_platform()) == []


def test_the_platform_says_ball_only_where_the_short_form_is_read() -> None:
    others = [path for path in of_platform() if name_of(path) not in SHORT_FORMS]
    assert lines_with(re.compile("ball", re.IGNORECASE), others) == []


# --- no cycles ----------------------------------------------------------------------------------------------------


def module_of(path: Path) -> str:
    return ".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__")


def import_graph() -> dict[str, set[str]]:
    """Modules of common that each module imports anywhere, for its types and within functions too."""
    paths = {module_of(path): path for path in sources("common", *ABOVE_COMMON)}
    graph: dict[str, set[str]] = {}
    for module, path in paths.items():
        named = list(imports(path))
        # `from a import b` says a and then a.b: where a.b is a module, it is that one.
        more = {(name.rpartition(".")[0], line) for name, line in named if name in paths}
        graph[module] = {name for name, line in named if name in paths and (name, line) not in more} - {module}
    return graph


def package_of(module: str) -> str:
    """Return common.<package>, a module directly in common, or a top-level folder; an application is a package."""
    depth = 2 if module.startswith(("common.", "applications.")) else 1
    return ".".join(module.split(".")[:depth])


def cycles(graph: dict[str, set[str]]) -> list[list[str]]:
    """Every group of nodes of which each is reached from each, sorted."""
    return [sorted(group) for group in _strongly_connected(graph) if len(group) > 1]


def _strongly_connected(graph: dict[str, set[str]]) -> list[set[str]]:
    def reached(start: str) -> set[str]:
        seen, todo = set[str](), [start]
        while todo:
            for following in graph.get(todo.pop(), set()) - seen:
                seen.add(following)
                todo.append(following)
        return seen

    after = {node: reached(node) for node in graph}
    groups = {frozenset({node} | {other for other in after[node] if node in after.get(other, ())}) for node in graph}
    return [set(group) for group in groups]


def test_no_modules_import_each_other_in_a_circle() -> None:
    assert cycles(import_graph()) == []


def test_no_packages_import_each_other_in_a_circle() -> None:
    packages: dict[str, set[str]] = {}
    for module, imported in import_graph().items():
        package = package_of(module)
        packages.setdefault(package, set()).update({package_of(name) for name in imported} - {package})
    assert cycles(packages) == []


def test_circles_are_seen() -> None:
    assert cycles({"a": {"b"}, "b": {"c"}, "c": {"a"}, "d": {"a"}}) == [["a", "b", "c"]]


@pytest.mark.parametrize("does", [
    "import services.camera_simulator, common.sim.kinematic",
    "import common.supervision.supervisor, recording.report.aggregator, cli.operation.operation as o\n"
    "o.Operation('panda', connect='tcp/127.0.0.1:9')",
], ids=["camera", "supervisor"])
def test_process_that_plans_nothing_loads_no_planner(does: str) -> None:
    told = f"{does}\nimport sys\nprint(*{{'pinocchio', 'coal', 'ompl', 'viser'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", told], cwd=ROOT, capture_output=True, text=True, check=False)
    assert (done.stdout.strip(), done.stderr) == ("", "")
