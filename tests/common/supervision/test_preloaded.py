"""Processes forked from a preloaded one: they behave as if the interpreter had started them."""

import asyncio
import os
import signal
import sys
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from common.supervision.child import Child
from common.supervision.preloaded import Forked, Preloaded

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux only")

MODULE = """
import os, sys
print(__name__, sys.argv[1:], os.environ["WHO"], os.getppid() == int(os.environ["PARENT"]), flush=True)
match sys.argv[1]:
    case "raise": raise RuntimeError("oh no")
    case "exit": sys.exit(3)
    case "read": print(repr(sys.stdin.readline()))
    case "wait": sys.stdin.read()
    case "orphan":
        import subprocess
        print(subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"], stdout=subprocess.DEVNULL,
                               stderr=subprocess.DEVNULL).pid)
"""
COMMAND = [sys.executable, "-P", "-m", "forked_toy"]


@pytest.fixture(scope="module")
def environment(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("modules")
    (folder / "forked_toy.py").write_text(MODULE, encoding="utf-8")
    root = Path(__file__).resolve().parents[3]
    return {**os.environ, "PYTHONPATH": f"{root}:{folder}", "WHO": "me", "PARENT": str(os.getpid())}


@pytest.fixture(scope="module")
def preloaded(environment: dict[str, str]) -> Iterator[Preloaded]:
    process = Preloaded(environment)
    process.wait_ready()
    yield process
    process.close()


def spawned(preloaded: Preloaded, environment: dict[str, str], *arguments: str) -> Forked:
    process = preloaded.spawn([*COMMAND, *arguments], environment)
    assert process is not None
    return process


def output_of(process: Forked) -> str:
    process.stdin.close()
    with process.stdout:
        return process.stdout.read().decode()


@pytest.mark.parametrize(("argument", "code", "text"), [
    ("run", 0, ""), ("exit", 3, ""), ("raise", 1, "RuntimeError: oh no\n"),
])
def test_forked_module_has_arguments_environment_parent_output_and_exit_code(
    preloaded: Preloaded, environment: dict[str, str], argument: str, code: int, text: str
) -> None:
    process = spawned(preloaded, {**environment, "WHO": "you"}, argument, "--option")
    output = output_of(process)
    assert output.startswith(f"__main__ ['{argument}', '--option'] you True\n") and output.endswith(text)
    assert process.wait() == code


def test_forked_process_shows_its_own_command_line_and_leads_a_session(
    preloaded: Preloaded, environment: dict[str, str]
) -> None:
    process = spawned(preloaded, environment, "wait", "--gate")
    process.stdout.readline()
    shown = psutil.Process(process.pid).cmdline()
    assert [part for part in shown if part.strip()] == [*COMMAND, "wait", "--gate"]
    assert os.getsid(process.pid) == process.pid
    os.kill(process.pid, signal.SIGKILL)
    assert (output_of(process), process.wait()) == ("", -signal.SIGKILL)


def test_other_commands_are_not_forked(preloaded: Preloaded, environment: dict[str, str]) -> None:
    for command in (["true"], [sys.executable, "-c", "1"], [sys.executable, "-m", "forked_toy"]):
        assert preloaded.spawn(command, environment) is None


async def run(environment: dict[str, str], process: Preloaded, argument: str) -> tuple[int, list[str]]:
    """Return exit code and output of a child."""
    lines: list[str] = []
    child = Child("it", [*COMMAND, argument], environment, lambda name, line: lines.append(line), process)
    child.start()
    child.release()
    async with asyncio.timeout(30):
        return await child.wait(), lines


async def test_child_that_was_forked_reads_its_gate_and_leaves_no_orphan(
    preloaded: Preloaded, environment: dict[str, str]
) -> None:
    assert await run(environment, preloaded, "read") == (0, ["__main__ ['read'] me True", "'go\\n'"])
    code, (_, orphan) = await run(environment, preloaded, "orphan")
    assert code == 0 and not psutil.pid_exists(int(orphan))


@pytest.mark.parametrize("lost", ["killed", "closed"])
async def test_child_starts_without_a_lost_preloaded_process(environment: dict[str, str], lost: str) -> None:
    process = Preloaded(environment)
    process.wait_ready()
    if lost == "killed":
        newest = max(psutil.Process().children(), key=lambda child: child.create_time())
        assert "common.supervision.preloaded" in newest.cmdline()
        newest.kill()
    else:
        process.close()
    assert await run(environment, process, "exit") == (3, ["__main__ ['exit'] me True"])
    process.close()
