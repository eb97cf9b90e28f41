"""Two hosts on one machine: network namespaces joined by a cable that can be unplugged."""

import os
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

ADDRESSES = ("10.231.77.1", "10.231.77.2")
END = 20.0  # [s] after SIGTERM


def why_not() -> str:
    """Return why this machine cannot simulate two hosts; empty if it can."""
    if sys.platform != "linux":
        return "network namespaces exist on Linux only"
    if os.geteuid() != 0:
        return "only root creates network namespaces"
    name = f"zencell-{os.getpid()}-try"
    try:
        made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    except FileNotFoundError:
        return "`ip` (iproute2) is not installed"
    if made.returncode:
        return f"no network namespace can be created: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "delete", name], check=True)
    return ""


@dataclass
class Host:
    """A network namespace with one end of the cable."""

    namespace: str
    address: str
    cable: str
    processes: list[subprocess.Popen[str]] = field(default_factory=list)

    def start(self, *command: str, file: Path, environment: dict[str, str] | None = None) -> subprocess.Popen[str]:
        """Start a process on the host; its output goes to the file."""
        with file.open("w", encoding="utf-8") as out:
            process = subprocess.Popen(
                ["ip", "netns", "exec", self.namespace, *command], stdout=out, stderr=subprocess.STDOUT, text=True,
                env={**os.environ, **(environment or {})}, start_new_session=True)
        self.processes.append(process)
        return process

    def call(self, *command: str) -> None:
        """Run a command on the host."""
        _run("ip", "netns", "exec", self.namespace, *command)

    def stop(self) -> None:
        """End all processes of the host.

        Raises:
            TimeoutError: some had to be killed.
        """
        stuck = []
        for process in self.processes:
            if process.poll() is None:
                process.terminate()  # not SIGINT: background processes of a shell ignore it
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
        self.hosts[0].call("ip", "link", "set", self.hosts[0].cable, "down")

    def plug_in(self) -> None:
        """Repair the link."""
        self.hosts[0].call("ip", "link", "set", self.hosts[0].cable, "up")


@contextmanager
def two_hosts() -> Iterator[TwoHosts]:
    """Create two linked hosts; remove them at the end of the block."""
    tag = f"z{os.getpid() % 100000}"
    made: list[Host] = []
    try:
        for letter, address in zip("ab", ADDRESSES, strict=True):
            host = Host(f"zencell-{tag}{letter}", address, f"{tag}{letter}")
            _run("ip", "netns", "add", host.namespace)
            made.append(host)
        first, second = made
        _run("ip", "link", "add", first.cable, "netns", first.namespace, "type", "veth",
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
                _run("ip", "netns", "delete", host.namespace)


def _run(*command: str) -> None:
    subprocess.run(command, check=True, capture_output=True, timeout=30)
