"""Processes, their log lines, counters and parameters."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from common.messages.basics import Finite, Header, Message, Name, Positive


class ServiceStatus(Message):
    """One process as the supervisor sees it."""

    name: str
    state: Literal["waiting", "starting", "ready", "restarting", "stopping", "stopped", "failed"]
    pid: int | None = None
    restarts: int = 0
    ready_seconds: Finite | None = Field(None, description="wall time from its start to its readiness token [s]")
    message: str = ""
    host: str = Field("", description="name of the computer that it runs on")


class SupervisorStatus(Message):
    """All processes of the cell."""

    header: Header = Header()
    cell: str
    services: list[ServiceStatus]
    host: str = Field("", description="name of the computer of this supervisor; each tells of the whole cell")
    speed: Positive = Field(1.0, description="cell time per wall time")
    epoch: int = Field(0, ge=0, description="when cell time and wall time were equal [ns since the Unix epoch]")
    seed: int = 0
    world: str = Field("", description="that replaces the cell's, as it was asked for")
    overrides: list[str] = Field([], description="PATH=VALUE, as they were asked for; secrets are left out")


class LogLine(Message):
    """A line of a service's log."""

    header: Header = Header()
    service: str
    level: Literal["debug", "info", "warning", "error", "critical"]
    message: str


class ServiceCounters(Message):
    """What a service's transport counted: dropped, refused and handled messages by key."""

    header: Header = Header()
    service: str
    writes: list[str] = Field([], description="keys that it writes")
    received: dict[str, int] = {}
    dropped: dict[str, int] = Field({}, description="newer message came before this one was read")
    invalid: dict[str, int] = Field({}, description="payloads that did not parse or validate")
    overflow: dict[str, int] = Field({}, description="events lost because the reader fell behind")


class Parameter(Message):
    """One parameter as it is now. `path` is what `--set` and a cell file call it."""

    path: Name = Field(description="such as services.camera_simulator.rate or motion.velocity_scaling")
    value: JsonValue
    default: JsonValue = None
    type: Literal["number", "integer", "boolean", "string", "list", "mapping"]
    minimum: Finite | None = None
    maximum: Finite | None = None
    choices: list[str] = []
    unit: str = ""
    description: str = ""
    runtime: bool = Field(False, description="may be changed while the service runs")
    changed: bool = Field(False, description="is no longer what the service was started with")


class ParameterRequest(Message):
    """Change parameters of a service, all of them or none; with nothing to set, ask what there is."""

    set: dict[Name, JsonValue] = Field({}, description="by path")
    dry_run: bool = Field(False, description="only say whether it could be done")
    by: str = Field("", description="who asks: is logged")


class ParameterReply(Message):
    """All parameters of the service, after the change. The stamp tells how the clocks of two hosts differ."""

    header: Header = Header()
    service: str
    parameters: list[Parameter]
