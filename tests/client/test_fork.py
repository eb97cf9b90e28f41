"""A process that was forked from one with an open cell says so instead of waiting for ever."""

import subprocess
import sys

from tests.harness import ROOT, environment, free_domain

PROGRAM = """
import asyncio, multiprocessing, sys
from common.client.blocking import LoopThread
from common.errors import ZencellError
from common.transport.endpoint import endpoint_of
from common.transport.router import open_router
from common.transport.zenoh_session import open_zenoh

endpoint = endpoint_of(sys.argv[1], None)
router = open_router([endpoint])
loop = LoopThread()

async def connect():
    session = await open_zenoh(endpoint)
    session.close()

def in_child():
    for attempt in (lambda: loop.wait(connect), lambda: asyncio.run(connect())):
        try:
            attempt()
        except ZencellError as error:
            print(error, flush=True)
    loop.end()

loop.wait(connect)
for method in ("fork", "spawn"):
    child = multiprocessing.get_context(method).Process(target=in_child if method == "fork" else print)
    child.start()
    child.join(20)
    print(method, child.exitcode, flush=True)
loop.wait(connect)
loop.end()
router.close()
"""


def test_forked_child_is_refused_with_one_line_and_the_parent_continues() -> None:
    done = subprocess.run([sys.executable, "-W", "ignore", "-c", PROGRAM, str(free_domain())], cwd=ROOT,
                          env=environment(), capture_output=True, text=True, timeout=60, check=False)
    lines = [line for line in done.stdout.splitlines() if line]
    assert done.returncode == 0, done.stderr
    assert len(lines) == 4 and lines[2:] == ["fork 0", "spawn 0"]
    assert all('start it with multiprocessing.get_context("spawn")' in line for line in lines[:2])
