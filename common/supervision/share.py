"""What `run` and `up` do on one of several hosts: a part of the cell, and a router that is linked with others."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from common.clock import EPOCH_VARIABLE
from common.errors import ConfigError, UnknownName

if TYPE_CHECKING:
    from common.config import Cell
    from common.supervision.launch import Launch


@dataclass(frozen=True)
class Share:
    """What was asked for of this host's share in a cell."""

    listen: Sequence[str] | None = None
    link: Sequence[str] | None = None
    only: Sequence[str] | None = None
    without: Sequence[str] | None = None

    def linked(self, launch: Launch) -> Launch:
        """The launch with the router listening and linked as options or environment say.

        Raises:
            ConfigError: one of the endpoints cannot be used, or the router is somebody else's.
        """
        from common.transport.endpoint import LINK_VARIABLE, LISTEN_VARIABLE, endpoints_of, listen_endpoints

        if launch.connect:
            for option, given in (("--listen", self.listen), ("--link", self.link)):
                if given:
                    raise ConfigError(option, given[0], "is for a router of our own: with --connect none is started")
            return launch
        wider = endpoints_of("--listen", self.listen or (), LISTEN_VARIABLE)
        links = endpoints_of("--link", self.link or (), LINK_VARIABLE)
        return replace(launch, listen=tuple(listen_endpoints(launch.domain, wider)) if wider else (), link=tuple(links))

    def part_of(self, cell: Cell) -> Cell:
        """The cell with those of its services that run on this host.

        Raises:
            ConfigError: both options were given, or nothing is left.
            UnknownName: the cell has no such service.
        """
        if self.only and self.without:
            raise ConfigError("--only", ",".join(self.only), "and --without are two ways to choose: give one of them")
        option, given = ("--only", self.only) if self.only else ("--without", self.without)
        if not given:
            return cell
        names = [name.strip() for text in given for name in text.split(",") if name.strip()]
        known = [entry.name for entry in cell.services.values()]
        for name in names:
            if name not in known:
                raise UnknownName(option, name, known)
        kept = {key: entry for key, entry in cell.services.items() if (entry.name in names) == bool(self.only)}
        if not kept:
            raise ConfigError(option, ",".join(given), "leaves no service to start")
        return cell.model_copy(update={"services": kept})

    def epoch(self, speed: float) -> int | None:
        """When cell time and wall time are equal [ns since the Unix epoch], where that was handed down.

        Raises:
            ConfigError: it cannot be used, or is missing though hosts could not agree on cell time without it.
        """
        given = os.environ.get(EPOCH_VARIABLE)
        if given:
            if not given.isdigit():
                raise ConfigError(EPOCH_VARIABLE, given, "must be a time in whole nanoseconds since 1970")
            return int(given)
        if (self.only or self.without) and speed != 1.0:
            raise ConfigError(
                "--speed", speed,
                f"needs {EPOCH_VARIABLE} on several hosts, the same on each, such as $(date +%s)000000000",
            )
        return None
