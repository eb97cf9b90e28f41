"""Start Python modules as processes by forking one process that has imported their common packages.

Importing numpy, pydantic, OpenCV and pinocchio takes 0.5 s of processor time and 60 MB for each service. The preloaded
process imports them once; a forked service shares its memory until it writes to it.

The supervisor is the parent of each forked process, as if it had started it: the preloaded process forks twice, and the
kernel hands the grandchild to the nearest subreaper, the supervisor. `/proc/PID/cmdline` shows the service's own
command. Only Linux offers this; elsewhere, and when the preloaded process does not answer, `spawn` returns None.
"""

from __future__ import annotations

import ctypes
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, NoReturn

from common.supervision import own_module

MODULES = (  # what most services import
    "common.process.service", "common.process.planning_scene", "common.perception.image", "common.robot.model",
    "common.planning.collision", "common.sim.interface", "common.tasks.engine",
)
PR_SET_CHILD_SUBREAPER = 36  # of linux/prctl.h
IMPORT_TIMEOUT = 10.0  # [s]
FORK_TIMEOUT = 1.0  # [s]
READY = b"ready"
ROOM = 4096  # [bytes] for the command line of a forked process
_MESSAGE = 1 << 20  # [bytes] largest request


class Preloaded:
    """The preloaded process, as its supervisor sees it. Call `wait_ready` before the first `spawn`."""

    def __init__(self, environment: Mapping[str, str]) -> None:
        """Start its imports; they run in parallel to this process."""
        self._socket: socket.socket | None = None
        self._process: subprocess.Popen[bytes] | None = None
        if sys.platform != "linux" or ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0):
            return
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        command = [sys.executable, "-P", "-m", "common.supervision.preloaded", str(theirs.fileno()), str(os.getpid())]
        with theirs:
            self._process = subprocess.Popen([*command, " " * ROOM], env=dict(environment), stdin=subprocess.DEVNULL,
                                             pass_fds=(theirs.fileno(),), start_new_session=True)
        self._socket = ours

    def wait_ready(self) -> None:
        """Wait for the end of the imports; without it, nothing is forked."""
        if self._socket is None:
            return
        self._socket.settimeout(IMPORT_TIMEOUT)
        try:
            ready = self._socket.recv(64) == READY
        except OSError:
            ready = False
        if ready:
            self._socket.settimeout(FORK_TIMEOUT)
        else:
            self.close()

    def spawn(self, command: Sequence[str], environment: Mapping[str, str]) -> Forked | None:
        """Fork `python -P -m MODULE ARGUMENTS...`; None if that is impossible: start it in the usual way then."""
        if self._socket is None or command[0] != sys.executable or "-m" not in command[2:4]:
            return None
        stdin, gate = os.pipe()
        output, stdout = os.pipe()
        request = json.dumps({"command": list(command), "environment": dict(environment)}).encode()
        try:
            socket.send_fds(self._socket, [request], [stdin, stdout])
            pid = int(self._socket.recv(64))
        except (OSError, ValueError):
            self.close()
            os.close(gate)
            os.close(output)
            return None
        finally:
            os.close(stdin)
            os.close(stdout)
        return Forked(pid, gate, output)

    def close(self) -> None:
        """End the preloaded process; forked ones continue."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None
        if self._process is not None:
            self._process.kill()
            self._process.wait()
            self._process = None
            ctypes.CDLL(None).prctl(PR_SET_CHILD_SUBREAPER, 0, 0, 0, 0)


class Forked:
    """A forked process: the part of `subprocess.Popen` that a supervisor uses."""

    def __init__(self, pid: int, stdin: int, stdout: int) -> None:
        self.pid = pid
        self.stdin: BinaryIO = os.fdopen(stdin, "wb", buffering=0)
        self.stdout: BinaryIO = os.fdopen(stdout, "rb", buffering=0)

    def wait(self) -> int:
        """Reap the process and return its exit code, minus the signal that killed it."""
        return os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])


def reap_group(pid: int) -> None:
    """Reap what a killed process group left: as a subreaper the supervisor inherits its orphans."""
    for _ in range(20):
        try:
            if os.waitpid(-pid, os.WNOHANG) == (0, 0):
                time.sleep(0.01)
        except ChildProcessError:
            return


# --- in the preloaded process -----------------------------------------------------------------------------------------


def _serve(channel: socket.socket, supervisor: int) -> None:
    """Fork on each request, until the supervisor closes its end."""
    for name in MODULES:
        importlib.import_module(name)
    gc.collect()
    gc.freeze()  # a collection in a child would write to shared pages
    channel.send(READY)
    while True:
        data, descriptors, _, _ = socket.recv_fds(channel, _MESSAGE, 2)
        if not data:
            return
        request = json.loads(data)
        read, write = os.pipe()
        if not (child := os.fork()):
            _fork_service(channel, supervisor, write, descriptors, request)
        os.close(write)
        for descriptor in descriptors:
            os.close(descriptor)
        os.waitpid(child, 0)
        channel.send(os.read(read, 64))
        os.close(read)


def _fork_service(
    channel: socket.socket, supervisor: int, write: int, descriptors: list[int], request: dict[str, object]
) -> NoReturn:
    """Fork the service and exit, so that the supervisor becomes its parent."""
    if service := os.fork():
        os.write(write, str(service).encode())
        os._exit(0)
    channel.close()
    os.close(write)
    try:
        _run(supervisor, descriptors, request["command"], request["environment"])  # type: ignore[arg-type]
    except SystemExit as end:
        os._exit(end.code if isinstance(end.code, int) else bool(end.code))
    except BaseException:  # noqa: BLE001  # as the interpreter would do
        traceback.print_exc()
        sys.stderr.flush()
        os._exit(1)
    os._exit(0)


def _run(supervisor: int, descriptors: list[int], command: list[str], environment: dict[str, str]) -> None:
    os.setsid()
    while os.getppid() != supervisor:  # the kernel hands this process over as soon as its parent has exited
        time.sleep(0.0005)
    stdin, stdout = descriptors
    os.dup2(stdin, 0)
    os.dup2(stdout, 1)
    os.dup2(stdout, 2)
    for descriptor in descriptors:
        os.close(descriptor)
    sys.stdin = open(0, encoding="utf-8", closefd=False)  # noqa: SIM115
    os.environ.clear()
    os.environ.update(environment)
    _set_command_line(command)
    at = command.index("-m") + 1
    if at == 3:
        sys.argv[1:] = command[4:]
        runpy.run_module(command[at], run_name="__main__", alter_sys=True)
    else:
        own_module.run(command[at], command[at + 1 :])


def _set_command_line(command: list[str]) -> None:
    """Write the command over the arguments of this process, where the kernel reads `/proc/PID/cmdline`."""
    fields = Path("/proc/self/stat").read_text(encoding="ascii").rpartition(")")[2].split()
    start, end = int(fields[45]), int(fields[46])  # arg_start and arg_end of proc(5)
    text = b"\0".join(part.encode() for part in command)[: end - start - 1]
    ctypes.memset(start, 0, end - start)
    ctypes.memmove(start, text, len(text))


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _serve(socket.socket(fileno=int(sys.argv[1])), int(sys.argv[2]))
