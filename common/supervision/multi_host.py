"""Cells that span several hosts: which services this host runs, and how its router links to other hosts."""

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
class HostOptions:
    """The options --listen, --link, --only and --without of this host."""

    listen: Sequence[str] | None = None
    link: Sequence[str] | None = None
    only: Sequence[str] | None = None
    without: Sequence[str] | None = None

    def linked(self, launch: Launch) -> Launch:
        """Return the launch with the router listening and linked as options or environment say.

        Raises:
            ConfigError: an endpoint is not valid, or no router of our own is started.
        """
        from common.transport.endpoint import LINK_VARIABLE, LISTEN_VARIABLE, endpoints_of, listen_endpoints

        if launch.connect:
            for option, given in (("--listen", self.listen), ("--link", self.link)):
                if given:
                    raise ConfigError(option, given[0], "configures our own router: with --connect none is started")
            return launch
        wider = endpoints_of("--listen", self.listen or (), LISTEN_VARIABLE)
        links = endpoints_of("--link", self.link or (), LINK_VARIABLE)
        return replace(launch, listen=tuple(listen_endpoints(launch.domain, wider)) if wider else (), link=tuple(links))

    def part_of(self, cell: Cell) -> Cell:
        """Return the cell with only the services that run on this host.

        Raises:
            ConfigError: both --only and --without were given, or no service is left.
            UnknownName: the cell has no such service.
        """
        if self.only and self.without:
            raise ConfigError("--only", ",".join(self.only), "and --without exclude each other: use one of them")
        option, given = ("--only", self.only) if self.only else ("--without", self.without)
        if not given:
            return cell
        names = [name.strip() for text in given for name in text.split(",") if name.strip()]
        known = [entry.name for entry in cell.services.values()]
        for name in names:
            if name not in known:
                raise UnknownName(option, name, known)
        here = {key: entry for key, entry in cell.services.items() if (entry.name in names) == bool(self.only)}
        if not here:
            raise ConfigError(option, ",".join(given), "leaves no service to start")
        return cell.model_copy(update={"services": here})

    def epoch(self, speed: float) -> int | None:
        """Return when cell time equals wall time [ns since the Unix epoch], if the environment says.

        Raises:
            ConfigError: it is not valid, or several hosts need it at another speed than 1.
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
