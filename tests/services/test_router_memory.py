"""The router frees the memory of a subscriber that read nothing, once it is dropped."""

import os
import subprocess
import sys
import threading
import time
from contextlib import ExitStack
from pathlib import Path

import pytest
import zenoh

from common.transport.endpoint import client_config
from tests.cells.subscribers import Subscriber
from tests.harness import ROOT, environment, free_domain

pytestmark = [pytest.mark.slow, pytest.mark.timeout(200)]

FROZEN, AWAKE = 4.0, 2.0  # [s] in which the router drops the subscriber, and it reconnects
IMAGE = os.urandom(921_600)
MOST = 0.17  # [MB] that may remain of each cycle; with memory arenas of threads it is 0.34


def memory(process: int) -> float:
    """Return the private memory [MB] of a process."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    sizes = dict(line.split(":", 1) for line in lines)
    return sum(int(sizes[name].split()[0]) for name in ("RssAnon", "RssShmem", "VmSwap")) / 1000


@pytest.mark.parametrize("cycles", [4, pytest.param(8, marks=pytest.mark.campaign)])
def test_router_frees_the_memory_of_a_frozen_subscriber(cycles: int) -> None:
    domain, stop = free_domain(), threading.Event()
    endpoint = f"tcp/127.0.0.1:{7447 + domain}"
    command = [sys.executable, "-m", "services.router", "--domain", str(domain)]
    with ExitStack() as stack:
        router = stack.enter_context(subprocess.Popen(command, cwd=ROOT, env=environment(), stdin=subprocess.PIPE))
        stack.callback(router.kill)
        writer = stack.enter_context(zenoh.open(client_config(endpoint, connect_ms=30_000)))
        frozen = stack.enter_context(Subscriber(endpoint, "panda/**", 0.0))

        def write() -> None:
            number = 0
            while not stop.wait(0.01):
                number += 1
                writer.put("panda/joint_states", bytes(250), congestion_control=zenoh.CongestionControl.BLOCK)
                if number % 5 == 0:
                    writer.put("panda/image", IMAGE, congestion_control=zenoh.CongestionControl.DROP)

        writing = threading.Thread(target=write)
        writing.start()
        stack.callback(writing.join)
        stack.callback(stop.set)
        seen = []
        for _ in range(1 + cycles):
            frozen.freeze()
            time.sleep(FROZEN)
            frozen.wake()
            time.sleep(AWAKE)
            seen.append(memory(router.pid))
        assert min(seen[-3:]) - seen[0] < MOST * (cycles - 2), seen
