"""Looks at the machine: what a cell needs, what is in its way, and what to do about it."""

from __future__ import annotations

import os
import platform
import shutil
import socket
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import PackageNotFoundError, requires, version
from itertools import pairwise
from pathlib import Path
from typing import Literal

import typer

from cli import options

SERVICE_MODULES = "services."
LEAST_MEMORY = 1.0  # [GB]
LEAST_SHM = 64.0  # [MB]
CLOCK_YEAR = 2024  # the system clock is wrong when it says an earlier year


@dataclass(frozen=True)
class Finding:
    """One thing that was looked at, and what to do when it is not well."""

    level: Literal["ok", "warn", "fail"]
    what: str
    remedy: str = ""


def doctor(domain: options.Domain = None, connect: options.Connect = None) -> None:
    """Check this machine and say what to do about what is not well; exit 1 if something fails."""
    from common.transport.endpoint import endpoint_of

    endpoint = endpoint_of(domain, connect)
    failed = False
    for finding in examine(endpoint):
        remedy = f": {finding.remedy}" if finding.remedy else ""
        typer.echo(f"{finding.level:<4}  {finding.what}{remedy}")
        failed |= finding.level == "fail"
    if failed:
        raise typer.Exit(1)


def examine(endpoint: str) -> Iterator[Finding]:
    """All findings, in the order in which they matter."""
    yield _python()
    yield from _packages()
    yield from _robots()
    yield _router(endpoint)
    yield _stale_processes()
    yield _shared_memory()
    yield _memory()
    yield _cores()
    yield _clock()


def _python() -> Finding:
    what = f"Python {platform.python_version()} ({sys.executable})"
    if sys.version_info < (3, 11):  # noqa: UP036 - a checkout may be run without being installed
        return Finding("fail", what, "install Python 3.11 or newer")
    return Finding("ok", what)


def _packages() -> Iterator[Finding]:
    try:
        needed = [text for text in requires("zencell") or [] if "extra ==" not in text]
    except PackageNotFoundError:
        yield Finding("warn", "zencell is not installed, only found", "pip install -c constraints.txt -e .")
        return
    found = []
    for text in needed:
        name = "".join(c if c.isalnum() or c in "-_." else " " for c in text).split()[0]
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            yield Finding("fail", f"package {name} is missing", "make setup, or pip install -c constraints.txt -e .")
    yield Finding("ok", f"packages: {', '.join(found)}")


def _robots() -> Iterator[Finding]:
    from common.config import RobotConfig, check, config_root, names_of, read_robot
    from common.errors import ZencellError

    for name in names_of("robots"):
        try:
            robot = check(RobotConfig, read_robot(config_root() / "robots" / f"{name}.yaml"))
            needed = [robot.urdf, robot.srdf, *(attachment.urdf for attachment in robot.attachments)]
            missing = [text for text in needed if text and not _described(text, robot.package_dirs)]
        except ZencellError as error:
            yield Finding("fail", f"robot {name}: {error}", "correct the file")
            continue
        if missing:
            yield Finding("fail", f"robot {name}: {missing[0]} is missing", "pip install example-robot-data")
        else:
            yield Finding("ok", f"robot {name}: description present")


def _described(uri: str, package_dirs: list[str]) -> bool:
    """Whether a robot description is there, found without loading any of the robotics packages."""
    if not uri.startswith("package://"):
        return Path(uri).expanduser().is_file()
    relative = uri.removeprefix("package://")
    roots = [Path(text).expanduser() for text in package_dirs]
    for entry in sys.path:
        roots.append(Path(entry) / "cmeel.prefix" / "share")
    return any((root / relative).is_file() for root in roots)


def _router(endpoint: str) -> Finding:
    from common.transport.router import holder_of

    host, _, port = endpoint.partition("/")[2].rpartition(":")
    try:
        with socket.create_connection((host.strip("[]"), int(port)), timeout=1.0):
            pass
    except ConnectionRefusedError:
        return Finding("ok", f"{endpoint} is free: no cell is up there")
    except OSError as error:
        return Finding("warn", f"{endpoint} can not be reached ({error})", "check --connect and the network")
    holder = holder_of(int(port))
    if SERVICE_MODULES + "router" in holder:
        return Finding("ok", f"{endpoint}: a router of zencell answers there, {holder}")
    return Finding("warn", f"{endpoint} is in use by {holder}", "stop it, or give zencell another --domain")


def _stale_processes() -> Finding:
    import psutil

    stale = []
    for process in psutil.process_iter(["pid", "ppid", "cmdline"]):
        command = process.info["cmdline"] or []
        ours = any(
            flag == "-m" and module.startswith(SERVICE_MODULES)
            for flag, module in pairwise(command)
        )
        if ours and process.info["ppid"] == 1 and "--gate" in command:
            stale.append(str(process.info["pid"]))
    if stale:
        return Finding("warn", f"services without a supervisor: {' '.join(stale)}", f"kill {' '.join(stale)}")
    return Finding("ok", "no service is left over from an earlier run")


def _shared_memory() -> Finding:
    try:
        free = shutil.disk_usage("/dev/shm").free / 1e6
    except OSError:
        return Finding("ok", "no /dev/shm here, and none is needed")
    if free < LEAST_SHM:
        return Finding("warn", f"/dev/shm has {free:.0f} MB left", "remove old files there, or give it more room")
    return Finding("ok", f"/dev/shm has {free:.0f} MB left")


def _memory() -> Finding:
    import psutil

    free = psutil.virtual_memory().available / 1e9
    if free < LEAST_MEMORY:
        return Finding("warn", f"{free:.1f} GB of memory left", f"a cell needs {LEAST_MEMORY:g} GB: close something")
    return Finding("ok", f"{free:.1f} GB of memory left")


def _cores() -> Finding:
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    load = os.getloadavg()[0]
    what = f"{cores} cores, load {load:.1f}"
    if cores < 2:
        return Finding("warn", what, "two cores are the least for speed 1 and more")
    if load > cores:
        return Finding("warn", what, "something else keeps this machine busy; expect late frames")
    return Finding("ok", what)


def _clock() -> Finding:
    now = time.gmtime()
    resolution = time.get_clock_info("monotonic").resolution
    if now.tm_year < CLOCK_YEAR:
        return Finding("warn", f"the clock says {now.tm_year}", "set it: stamps of messages are taken from it")
    if resolution > 1e-3:
        return Finding("warn", f"the clock ticks every {resolution * 1e3:g} ms", "expect uneven motion")
    return Finding("ok", f"clock {time.strftime('%Y-%m-%d %H:%M:%S', now)} UTC, monotonic to {resolution * 1e9:g} ns")
