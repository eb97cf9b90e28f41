import asyncio
import os
import sys

from common.supervision.child import LONGEST_LINE, TAIL_LINES, Child, describe_exit


async def lines_of(script: str, *, release: bool = False) -> tuple[Child, list[str], int]:
    lines: list[str] = []
    child = Child("it", [sys.executable, "-c", script], os.environ, lambda name, line: lines.append(line))
    child.start()
    if release:
        child.release()
    async with asyncio.timeout(20):
        code = await child.wait()
    return child, lines, code


async def test_lines_of_both_streams_come_with_the_last_one_unfinished() -> None:
    _, lines, code = await lines_of("import sys; print('a', flush=True); sys.stderr.write('b\\nc'); sys.exit(3)")
    assert lines == ["a", "b", "c"]
    assert code == 3


async def test_only_the_last_lines_are_kept() -> None:
    child, lines, _ = await lines_of("for i in range(200): print(i)")
    assert len(lines) == 200
    assert list(child.tail) == [str(i) for i in range(200 - TAIL_LINES, 200)]


async def test_endless_lines_and_bytes_that_are_no_text_do_no_harm() -> None:
    script = "import sys; b = sys.stdout.buffer; b.write(b'x' * 1_000_000 + b'\\n\\xff\\xfe\\n'); b.flush()"
    _, lines, _ = await lines_of(script)
    assert len(lines) == 2
    assert len(lines[0]) == LONGEST_LINE


async def test_a_released_process_reads_one_line_and_the_end_of_its_parent_closes_it() -> None:
    _, lines, code = await lines_of("import sys; print(repr(sys.stdin.readline()))", release=True)
    assert lines == ["'go\\n'"]
    assert code == 0


async def test_a_process_that_is_gone_can_be_told_anything() -> None:
    child, _, _ = await lines_of("")
    child.release()
    child.terminate()
    child.kill()
    assert child.pid is None


def test_exit_codes_are_described() -> None:
    assert describe_exit(1) == "exit code 1"
    assert describe_exit(-9) == "killed by SIGKILL"
    assert describe_exit(-250) == "killed by signal 250"
