"""Two hosts on one machine: network namespaces joined by a cable that can be unplugged."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

ADDRESSES = ("10.231.77.1", "10.231.77.2")
END = 20.0  # [s] after Ctrl-C


def why_not() -> str:
    """Why there can be no two hosts here; empty when there can."""
    if sys.platform != "linux":
        return "network namespaces are Linux's"
    if os.geteuid() != 0:
        return "only root makes network namespaces"
    name = f"zencell-{os.getpid()}-try"
    try:
        made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return "there is no `ip` (iproute2)"
    if made.returncode:
        return f"no network namespace can be made: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "delete", name], check=True)
    return ""


@dataclass
class Host:
    """One of the two: a network namespace."""

    namespace: str
    address: str
    cable: str  # its end of it
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    def start(self, *command: str, file: Path, environment: dict[str, str] | None = None) -> subprocess.Popen[str]:
        """A process on the host; what it says goes to the file."""
        with file.open("w", encoding="utf-8") as out:
            process = subprocess.Popen(
                ["ip", "netns", "exec", self.namespace, *command], stdout=out, stderr=subprocess.STDOUT, text=True,
                env={**os.environ, **(environment or {})}, start_new_session=True,
            )
        self.processes.append(process)
        return process

    def call(self, *command: str) -> str:
        """What a command says on the host."""
        return subprocess.run(
            ["ip", "netns", "exec", self.namespace, *command], capture_output=True, text=True, check=True, timeout=30,
        ).stdout

    def stop(self) -> None:
        """End what still runs.

        Raises:
            TimeoutError: some of it had to be killed.
        """
        stuck = []
        for process in self.processes:
            if process.poll() is None:
                process.terminate()  # not Ctrl-C: what a shell starts in the background ignores that
        for process in self.processes:
            try:
                process.wait(timeout=END)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()
                stuck.append(process.args)
        self.processes.clear()
        if stuck:
            raise TimeoutError(f"had to be killed: {stuck}")


@dataclass
class TwoHosts:
    """Two hosts and the cable between them."""

    hosts: tuple[Host, Host]

    def unplug(self) -> None:
        """Cut the link."""
        self._cable("down")

    def plug_in(self) -> None:
        """Join them again."""
        self._cable("up")

    def _cable(self, state: str) -> None:
        host = self.hosts[0]
        host.call("ip", "link", "set", host.cable, state)


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Two hosts, joined; nothing of them is left afterwards."""
    tag = f"z{os.getpid() % 100000}"
    made: list[Host] = []
    try:
        for letter, address in zip("ab", ADDRESSES, strict=True):
            host = Host(f"zencell-{tag}{letter}", address, f"{tag}{letter}")
            _ip("netns", "add", host.namespace)
            made.append(host)
        first, second = made
        _ip("link", "add", first.cable, "netns", first.namespace, "type", "veth",
            "peer", "name", second.cable, "netns", second.namespace)
        for host in made:
            host.call("ip", "address", "add", f"{host.address}/24", "dev", host.cable)
            host.call("ip", "link", "set", "lo", "up")
            host.call("ip", "link", "set", host.cable, "up")
        yield TwoHosts((first, second))
    finally:
        for host in made:
            try:
                host.stop()
            finally:
                _ip("netns", "delete", host.namespace)


def _ip(*arguments: str) -> None:
    subprocess.run(["ip", *arguments], check=True, capture_output=True, timeout=30)
