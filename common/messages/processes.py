"""Processes, their log lines, counters and parameters."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from common.messages.basics import (
    MAX_STAMP,
    SMALL_BYTES,
    Count,
    Finite,
    Header,
    Label,
    Message,
    Name,
    Plain,
    Positive,
    Text,
)

MAX_KEYS = 256
Counts = Annotated[dict[Label, Count], Field(max_length=MAX_KEYS)]


class ServiceStatus(Message):
    """One process as the supervisor sees it."""

    name: Label
    state: Literal["waiting", "starting", "ready", "restarting", "stopping", "stopped", "failed"]
    pid: Count | None = None
    restarts: Count = 0
    ready_seconds: Finite | None = Field(None, description="wall time from its start to its readiness token [s]")
    message: Text = ""
    host: Label = Field("", description="name of the host that it runs on")


class Notice(Message):
    """A notice about a host for the operator, such as a certificate that expires soon."""

    urgent: bool = False
    message: Text
    host: Label = Field("", description="name of the host")


class SupervisorStatus(Message):
    """All processes of the cell."""

    max_bytes: ClassVar[int] = 256 * 1024
    max_parts: ClassVar[int] = 8 * 1024
    omitted_defaults: ClassVar[tuple[str, ...]] = ("has_task",)

    header: Header = Header()
    cell: Label
    has_task: bool = Field(True, description="without a task operators release their stops themselves")
    services: list[ServiceStatus] = Field(max_length=1000)
    host: Label = Field("", description="name of the host of this supervisor; each reports the complete cell")
    speed: Positive = Field(1.0, description="cell time per wall time")
    epoch: int = Field(
        0, ge=0, le=MAX_STAMP, description="when cell time and wall time were equal [ns since the Unix epoch]"
    )
    booted: int = Field(
        0, ge=-MAX_STAMP, le=MAX_STAMP, description="time at which its boot clock was at 0 [ns since the Unix epoch]"
    )
    seed: int = 0
    world: Text = Field("", description="world that replaces the cell's, as requested")
    overrides: list[Text] = Field(
        [], max_length=1000, description="PATH=VALUE, as requested, without secrets"
    )
    notices: list[Notice] = Field([], max_length=1000, description="certificates that expire soon or have expired")


class LogLine(Message):
    """A line of a service's log."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    service: Label
    level: Literal["debug", "info", "warning", "error", "critical"]
    message: Text


class ServiceCounters(Message):
    """Numbers of received, dropped and refused messages of a service by key."""

    max_bytes: ClassVar[int] = SMALL_BYTES

    header: Header = Header()
    service: Label
    writes: list[Label] = Field([], max_length=MAX_KEYS, description="keys that it writes")
    received: Counts = {}
    dropped: Counts = Field({}, description="replaced by a newer message before it was read")
    invalid: Counts = Field({}, description="payloads that did not parse or validate")
    overflow: Counts = Field({}, description="events lost because the reader fell behind")


class Parameter(Message):
    """One parameter with its current value. `path` is its name in `--set` and in cell files."""

    path: Name = Field(description="such as services.camera_simulator.rate or motion.velocity_scaling")
    value: Plain
    default: Plain = None
    type: Literal["number", "integer", "boolean", "string", "list", "mapping"]
    minimum: Finite | None = None
    maximum: Finite | None = None
    choices: list[Text] = Field([], max_length=1000)
    unit: Label = ""
    description: Text = ""
    runtime: bool = Field(False, description="may be changed while the service runs")
    changed: bool = Field(False, description="differs from the value at the start of the service")


class ParameterRequest(Message):
    """Change parameters of a service, all or none; an empty request reads them."""

    max_bytes: ClassVar[int] = 4 * SMALL_BYTES
    max_parts: ClassVar[int] = 1024

    set: dict[Name, Plain] = Field({}, max_length=256, description="by path")
    dry_run: bool = Field(False, description="only validate the change")
    by: Label = Field("", description="name of the requester, for the log")


class ParameterReply(Message):
    """All parameters of the service after the change. The stamp shows the clock offset between two hosts."""

    header: Header = Header()
    service: Label
    parameters: list[Parameter] = Field(max_length=2000)
