"""Parameters of a running service: what there is, and changing it."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, JsonValue

from common.messages.basics import Finite, Header, Message, Name


class Parameter(Message):
    """One parameter as it is now. `path` is what `--set` and a cell file call it."""

    path: Name = Field(description="such as services.vision_detector.min_saturation or motion.velocity_scaling")
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
