"""Child processes: output, gate, exit codes, and the delay before a restart."""

import asyncio
import os
import sys

import pytest

from common.supervision.child import LONGEST_LINE, TAIL_LINES, Backoff, Child, describe_exit


async def run_child(script: str, *, release: bool = False) -> tuple[Child, list[str], int]:
    lines: list[str] = []
    child = Child("it", [sys.executable, "-c", script], os.environ, lambda name, line: lines.append(line))
    child.start()
    if release:
        child.release()
    async with asyncio.timeout(20):
        code = await child.wait()
    return child, lines, code


async def test_lines_of_stdout_and_stderr_are_read_up_to_an_incomplete_last_line() -> None:
    child, lines, code = await run_child("import sys; print('a', flush=True); sys.stderr.write('b\\nc'); sys.exit(3)")
    assert (lines, code) == (["a", "b", "c"], 3)
    child.release()
    child.terminate()
    child.kill()
    assert child.pid is None, "calls on an ended process have no effect"


async def test_tail_has_the_last_lines_and_long_or_undecodable_ones_are_cut_or_replaced() -> None:
    child, lines, _ = await run_child(
        "import sys; b = sys.stdout.buffer; b.write(b'x' * 1_000_000 + b'\\n\\xff\\xfe\\n'); b.flush()\n"
        "for i in range(200): print(i)")
    assert len(lines) == 202 and len(lines[0]) == LONGEST_LINE
    assert list(child.tail) == [str(i) for i in range(200 - TAIL_LINES, 200)]


async def test_release_writes_one_line_to_stdin() -> None:
    assert (await run_child("import sys; print(repr(sys.stdin.readline()))", release=True))[1:] == (["'go\\n'"], 0)


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
