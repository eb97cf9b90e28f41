"""Child processes: output, gate, exit codes, delay before a restart, and children forked from a preloaded process."""

import asyncio
import os
import signal
import sys
from collections.abc import Iterator

import psutil
import pytest

from common.supervision.child import LONGEST_LINE, TAIL_LINES, Backoff, Child, describe_exit
from common.supervision.preloaded import Forked, Preloaded
from tests.harness import ROOT

linux = pytest.mark.skipif(sys.platform != "linux", reason="forks on Linux only")


async def run(
    command: list[str], environment: dict[str, str] | None = None, process: Preloaded | None = None, *,
    release: bool = True,
) -> tuple[Child, list[str], int]:
    """Run a child to its end; return it, its output and its exit code."""
    lines: list[str] = []
    child = Child("it", command, environment or dict(os.environ), lambda name, line: lines.append(line), process)
    child.start()
    if release:
        child.release()
    async with asyncio.timeout(30):
        return child, lines, await child.wait()


def python(script: str) -> list[str]:
    return [sys.executable, "-c", script]


async def test_lines_of_stdout_and_stderr_are_read_up_to_an_incomplete_last_line() -> None:
    script = "import sys; print('a', flush=True); sys.stderr.write('b\\nc'); sys.exit(3)"
    child, lines, code = await run(python(script), release=False)
    assert (lines, code) == (["a", "b", "c"], 3)
    child.release()
    child.terminate()
    child.kill()
    assert child.pid is None, "calls on an ended process have no effect"


async def test_tail_has_the_last_lines_and_long_or_undecodable_ones_are_cut_or_replaced() -> None:
    child, lines, _ = await run(python(
        "import sys; b = sys.stdout.buffer; b.write(b'x' * 1_000_000 + b'\\n\\xff\\xfe\\n'); b.flush()\n"
        "for i in range(200): print(i)"))
    assert len(lines) == 202 and len(lines[0]) == LONGEST_LINE
    assert list(child.tail) == [str(i) for i in range(200 - TAIL_LINES, 200)]


async def test_release_writes_one_line_to_stdin() -> None:
    assert (await run(python("import sys; print(repr(sys.stdin.readline()))")))[1:] == (["'go\\n'"], 0)


@pytest.mark.parametrize(("code", "text"), [
    (1, "exit code 1"), (70, "its event loop was stuck, exit code 70"), (-9, "killed by SIGKILL"),
    (-250, "killed by signal 250"),
])
def test_exit_code_is_described(code: int, text: str) -> None:
    assert describe_exit(code) == text


def test_backoff_doubles_up_to_its_cap_and_starts_over_after_a_long_run() -> None:
    backoff = Backoff()
    assert [backoff.after(1.0) for _ in range(8)] == [0.1, 0.2, 0.4, 0.8, 1.6, 3.2, 5.0, 5.0]
    assert [backoff.after(run) for run in (10.0, 9.9, 100.0, 0.0)] == [0.1, 0.2, 0.1, 0.2]


# --- children forked from a preloaded process: as if the interpreter had started them --------------------------------

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
def environment(tmp_path_factory) -> dict[str, str]:
    folder = tmp_path_factory.mktemp("modules")
    (folder / "forked_toy.py").write_text(MODULE, encoding="utf-8")
    return {**os.environ, "PYTHONPATH": f"{ROOT}:{folder}", "WHO": "me", "PARENT": str(os.getpid())}


@pytest.fixture(scope="module")
def preloaded(environment: dict[str, str]) -> Iterator[Preloaded]:
    process = Preloaded(environment)
    process.wait_ready()
    yield process
    process.close()


def output_of(process: Forked) -> str:
    process.stdin.close()
    with process.stdout:
        return process.stdout.read().decode()


@linux
@pytest.mark.parametrize(("argument", "code", "text"), [
    ("run", 0, ""), ("exit", 3, ""), ("raise", 1, "RuntimeError: oh no\n"),
])
def test_forked_module_runs_like_a_started_one(preloaded, environment, argument: str, code: int, text: str) -> None:
    process = preloaded.spawn([*COMMAND, argument, "--option"], {**environment, "WHO": "you"})
    output = output_of(process)
    assert output.startswith(f"__main__ ['{argument}', '--option'] you True\n") and output.endswith(text)
    assert process.wait() == code


@linux
def test_forked_process_has_its_own_command_line_and_session(preloaded: Preloaded, environment: dict[str, str]) -> None:
    process = preloaded.spawn([*COMMAND, "wait", "--gate"], environment)
    process.stdout.readline()
    shown = psutil.Process(process.pid).cmdline()
    assert [part for part in shown if part.strip()] == [*COMMAND, "wait", "--gate"]
    assert os.getsid(process.pid) == process.pid
    os.kill(process.pid, signal.SIGKILL)
    assert (output_of(process), process.wait()) == ("", -signal.SIGKILL)
    for command in (["true"], [sys.executable, "-c", "1"], [sys.executable, "-m", "forked_toy"]):
        assert preloaded.spawn(command, environment) is None


@linux
async def test_forked_child_reads_its_gate_and_leaves_no_orphan(preloaded: Preloaded, environment) -> None:
    _, lines, code = await run([*COMMAND, "read"], environment, preloaded)
    assert (lines, code) == (["__main__ ['read'] me True", "'go\\n'"], 0)
    _, (_, orphan), code = await run([*COMMAND, "orphan"], environment, preloaded)
    assert code == 0 and not psutil.pid_exists(int(orphan))


@linux
async def test_child_starts_without_a_lost_preloaded_process(environment: dict[str, str]) -> None:
    process = Preloaded(environment)
    process.wait_ready()
    newest = max(psutil.Process().children(), key=lambda child: child.create_time())
    assert "common.supervision.preloaded" in newest.cmdline()
    for lose in (newest.kill, process.close):
        lose()
        _, lines, code = await run([*COMMAND, "exit"], environment, process)
        assert (lines, code) == (["__main__ ['exit'] me True"], 3)
