"""What the services of a cell file have to do with each other, found without running the cell."""

from __future__ import annotations

import asyncio
import importlib
import sys
from contextlib import redirect_stdout
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from common.errors import ZencellError

if TYPE_CHECKING:
    from common.config import Cell, Parameters, ServiceEntry
    from common.topics import Request, Topic


class Unwired(ZencellError):
    """A service that cannot say what it declares."""

    exit_code = 1

    def __init__(self, service: str, error: BaseException) -> None:
        super().__init__(f"services.{service}: does not get as far as saying what it declares: {error!r}")
        self.service = service


@dataclass
class Wired:
    """One service: what it is, and the keys that it has to do with."""

    name: str
    doc: str
    config: Parameters | None = None
    reads: list[str] = field(default_factory=list)
    writes: list[str] = field(default_factory=list)
    serves: list[str] = field(default_factory=list)
    calls: list[str] = field(default_factory=list)
    topics: dict[str, Topic[Any] | Request[Any, Any]] = field(default_factory=dict)  # all of these, by key


def wired(cell: Cell, entry: ServiceEntry) -> Wired:
    """One service of a cell, run until it would be ready, on a network of its own.

    Raises:
        ConfigError: its parameters or its module cannot be used.
        Unwired: it does not get so far.
    """
    from common.config import service_config
    from common.process.wiring import wiring
    from common.supervision.launch import require_module

    require_module(entry.name, entry)
    try:
        module = importlib.import_module(entry.module)
    except Exception as error:  # whatever a person's own module does
        raise Unwired(entry.name, error) from error
    config = service_config(cell, entry.name, module.Config)
    # A service that listens at a port of its own may be up: another copy must not want the same one.
    apart = config.model_copy(update={"port": 0}) if "port" in module.Config.model_fields else config
    try:
        with redirect_stdout(sys.stderr):  # stdout is for what was asked
            found = asyncio.run(wiring(module.run, apart, service=entry.name, topics=entry.topics))
    except ZencellError:
        raise
    except Exception as error:
        raise Unwired(entry.name, error) from error
    doc = (module.__doc__ or "").strip().partition("\n")[0]
    sides = ([topic for topic in side if not topic.signed]  # every service has those
             for side in (found.reads, found.writes, found.serves, found.calls))
    reads, writes, serves, calls = (_in_order(side) for side in sides)
    every: set[Topic[Any] | Request[Any, Any]] = {*found.reads, *found.writes, *found.serves, *found.calls}
    return Wired(entry.name, doc, config, reads, writes, serves, calls, {topic.key: topic for topic in every})


def _in_order(side: list[Any]) -> list[str]:
    """Keys in the order of common/topics.py, then others."""
    from common.application import all_topics

    known = list(all_topics())
    keys = {topic.key for topic in side}
    return [key for key in known if key in keys] + sorted(keys.difference(known))
