"""Who may import whom, held by walking the syntax trees; and what no tracked file may contain."""

import ast
import re
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parent.parent
PURE = ("robot", "scene", "planning", "perception", "tasks", "hardware", "sim", "recording", "reporting")
NOT_PURE = ("asyncio", "zenoh", "common.topics", "common.transport", "common.supervision", "services", "cli")
CONTAINER_FILES = ("Dockerfile", "compose.yaml", ".dockerignore")
MACHINE_PATH = re.compile(rb"(?<![\w.])/(?:home|root|work|Users|farm)/\w")


def sources(*folders: str) -> list[Path]:
    return sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py"))


def imports(path: Path) -> Iterator[tuple[str, int]]:
    """Dotted names that a file imports anywhere, each with its line; `from a import b` yields a and a.b."""
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


def test_common_never_imports_services_or_the_command_line() -> None:
    assert offences(sources("common"), ("services", "cli")) == []


def test_only_the_transport_imports_zenoh() -> None:
    transport = ROOT / "common" / "transport"
    others = [path for path in sources("common", "services", "cli") if transport not in path.parents]
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
