"""One message as it travelled, with when it came and who wrote it."""

from __future__ import annotations

from dataclasses import dataclass, field

from common.errors import ZencellError

PREFIX = "application/msgpack;"  # of an encoding; the name of the message class follows


class RecordingError(ZencellError):
    """A recording that cannot be read, written or used like this: names the file and what to do."""


@dataclass(frozen=True, slots=True)
class Sample:
    """One message as it travelled. Times are wall clock, `publish_time` is cell time [ns since the Unix epoch]."""

    key: str  # full: <cell>/<topic>
    payload: bytes
    log_time: int  # of arrival
    publish_time: int = 0  # stamp of its header; the log time where it has none
    message: str = ""  # name of its class, empty where the sender does not say
    kind: str = "stream"  # or event, state
    writer: str = ""  # empty for a sender that does not say who it is
    sequence: int = 0
    trace: str = ""
    schema: bytes = field(default=b"", repr=False, compare=False)  # JSON, where a recording tells it

    @property
    def topic(self) -> str:
        """The key without the cell."""
        return self.key.partition("/")[2]

    @property
    def cell(self) -> str:
        """Name of the cell."""
        return self.key.partition("/")[0]


def message_of(encoding: str) -> str:
    """Name of the message class in an encoding such as `application/msgpack;Image`; empty if there is none."""
    return encoding.removeprefix(PREFIX) if encoding.startswith(PREFIX) else ""


def encoding_of(message: str) -> str:
    """The encoding under which messages of the class travel."""
    return PREFIX + message if message else PREFIX.rstrip(";")
