"""What a subscriber that reads nothing costs the router is gone when it is."""

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

CYCLES = 8
FROZEN, AWAKE = 4.0, 2.0  # [s] the router drops it meanwhile, and it comes back
PICTURE = os.urandom(921_600)
MOST = 1.0  # [MB] that stays; with a store of memory for each thread it is 1.7 after five times


def held(process: int) -> float:
    """Memory [MB] that a process has for itself."""
    lines = Path(f"/proc/{process}/status").read_text(encoding="ascii").splitlines()
    sizes = dict(line.split(":", 1) for line in lines)
    return sum(int(sizes[name].split()[0]) for name in ("RssAnon", "RssShmem", "VmSwap")) / 1000


def test_a_frozen_subscriber_costs_the_router_nothing_that_stays() -> None:
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
                    writer.put("panda/image", PICTURE, congestion_control=zenoh.CongestionControl.DROP)

        writing = threading.Thread(target=write)
        writing.start()
        stack.callback(writing.join)
        stack.callback(stop.set)
        seen = []
        for _ in range(1 + CYCLES):
            frozen.freeze()
            time.sleep(FROZEN)
            frozen.wake()
            time.sleep(AWAKE)
            seen.append(held(router.pid))
        assert min(seen[-3:]) - seen[0] < MOST, seen
