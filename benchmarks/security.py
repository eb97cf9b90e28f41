"""What certificates cost: time to open a session, latency through the router, processor time of the router.

Run as `python -m benchmarks.security`.
"""

from __future__ import annotations

import json
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

import psutil
import zenoh

from common.supervision.launch import free_endpoints
from common.transport.credentials import Credentials, credentials_of
from common.transport.endpoint import client_config, endpoint_of
from tests.harness import command_line, environment, free_domain

SESSIONS, MESSAGES, PERIOD = 20, 300, 0.01
SIZES = {"100 B": 100, "921,600 B": 921_600}
KEY = "panda/camera/image_raw"
WRITER, READER = "panda.camera_simulator", "panda.vision_detector"


def open_session(endpoint: str, credentials: Credentials | None) -> zenoh.Session:
    """A client of the router, for which it waits 20 s at most."""
    return zenoh.open(client_config(endpoint, connect_ms=20_000, credentials=credentials))


def latencies(endpoint: str, folder: Path | None, size: int) -> list[float]:
    """One-way times of pictures from one session to another [ms], sorted."""
    who = [credentials_of(name, folder) if folder else None for name in (WRITER, READER)]
    taken: list[float] = []
    last = threading.Event()

    def on_sample(sample: zenoh.Sample) -> None:
        taken.append((time.monotonic_ns() - int(sample.payload.to_bytes()[:20])) / 1e6)

    with open_session(endpoint, who[0]) as writer, open_session(endpoint, who[1]) as reader:
        subscriber = reader.declare_subscriber(KEY, zenoh.handlers.Callback(on_sample, indirect=False))
        publisher = writer.declare_publisher(KEY, express=True)
        last.wait(1.0)
        for _ in range(MESSAGES):
            publisher.put(f"{time.monotonic_ns():020d}".encode() + bytes(size - 20))
            last.wait(PERIOD)
        last.wait(0.5)
        subscriber.undeclare()
    return sorted(taken)


def measure(folder: Path | None, *, near: bool = False) -> dict[str, object]:
    """The figures of a router in a process of its own; with certificates through its front, or near it."""
    domain = free_domain()
    secured = {"ZENCELL_SECURE": str(folder)} if folder else {}
    endpoint = endpoint_of(domain, environ=secured)
    command = [sys.executable, "-m", "services.router", "--domain", str(domain)]
    if near:
        (endpoint,) = free_endpoints(1)
        command += ["--near", endpoint]
    router = subprocess.Popen(
        command, stdin=subprocess.PIPE,
        stderr=subprocess.DEVNULL, env={**environment(), **secured},
    )
    try:
        credentials = credentials_of(WRITER, folder) if folder else None
        open_session(endpoint, credentials).close()  # type: ignore[no-untyped-call]
        opened = []
        for _ in range(SESSIONS):
            began = time.perf_counter()
            with open_session(endpoint, credentials):
                opened.append((time.perf_counter() - began) * 1e3)
        figures: dict[str, object] = {"open a session [ms]": round(statistics.median(opened), 1)}
        for label, size in SIZES.items():
            before = psutil.Process(router.pid).cpu_times()
            taken = latencies(endpoint, folder, size)
            after = psutil.Process(router.pid).cpu_times()
            used = after.user + after.system - before.user - before.system
            figures[f"{label}: p50, p99 [ms], router [ms a message]"] = (
                round(taken[len(taken) // 2], 2), round(taken[int(len(taken) * 0.99)], 2),
                round(used / MESSAGES * 1e3, 2),
            )
        return figures
    finally:
        router.terminate()
        router.wait()


def main() -> None:
    """Print the figures without and with certificates."""
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "certificates"
        subprocess.run(command_line("secure", "init", str(folder)), env=environment(), check=True, capture_output=True)
        for label, given in (("open", None), ("with certificates", folder), ("near", folder)):
            print(label, json.dumps(measure(given, near=label == "near"), indent=1), flush=True)


if __name__ == "__main__":
    main()
