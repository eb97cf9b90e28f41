"""An I/O backend whose server a test switches off, and whose values a test changes."""

from __future__ import annotations

from typing import Any, ClassVar

from common.config import Parameters
from common.errors import Refused
from common.hardware.signals import IoLost, Unreadable


class IoOptions(Parameters):
    pass


class Server:
    """What is beyond the network; it survives connections."""

    values: ClassVar[dict[str, Any]] = {}
    writes: ClassVar[list[tuple[str, Any]]] = []
    down = ""
    refused: ClassVar[set[str]] = set()

    @classmethod
    def restart(cls, **values: Any) -> None:
        cls.values, cls.writes, cls.down, cls.refused = values, [], "", set()


class Connection:
    async def connect(self) -> None:
        self._require()

    async def read(self) -> dict[str, Any]:
        self._require()
        return dict(Server.values)

    async def write(self, name: str, value: Any) -> None:
        self._require()
        if name in Server.refused:
            raise Refused("device", f"{name}: short circuit")
        Server.values[name] = value
        Server.writes.append((name, value))

    async def close(self) -> None:
        pass

    def _require(self) -> None:
        if Server.down:
            raise IoLost(Server.down)


BROKEN = Unreadable("sensor is unplugged")


def create_io(signals: Any, options: IoOptions, now: Any) -> Connection:
    return Connection()
