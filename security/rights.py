"""What each process of a cell may do: its services declare what they need, without running."""

from __future__ import annotations

import asyncio
from collections.abc import Collection

from common.config import Cell
from common.errors import ZencellError
from common.supervision.launch import require_modules
from common.supervision.wiring import Wiring, WiringFailed, require_one_owner, wiring_of
from common.transport.credentials import RECORDER, SUPERVISOR
from security.access import Rights, rights_of, rights_of_recorder, rights_of_supervisor
from security.page_tokens import VIEWER


def rights_in(cell: Cell, names: Collection[str] | None = None) -> dict[str, Rights]:
    """What each process of a cell may do, found by letting its services declare what they need.

    Args:
        cell: resolved; the whole of it, because what a service declares may depend on who else is there.
        names: of the services that are looked at; all when not given.

    Raises:
        ConfigError: one of them cannot be configured so, or two of them write or serve one key.
        WiringFailed: one of them does not get so far.
    """
    require_modules(cell)
    apart = cell.model_copy(update={"services": {
        # The page listens while it is looked at: where nobody else does, for the cell may be up.
        key: entry.model_copy(update={"parameters": {**entry.parameters, "host": "127.0.0.1", "port": 0}})
        if entry.kind == VIEWER else entry for key, entry in cell.services.items()
    }})

    async def find() -> dict[str, Wiring]:
        found = {}
        for entry in apart.services.values():
            if names is not None and entry.name not in names:
                continue
            try:
                found[entry.name] = await wiring_of(apart, entry)
            except ZencellError:
                raise
            except Exception as error:  # whatever a service does that cannot run so
                raise WiringFailed(entry.name, error) from error
        return found

    wirings = asyncio.run(find())
    require_one_owner(wirings)
    rights = {name: rights_of(name, declared) for name, declared in wirings.items()}
    return {**rights, SUPERVISOR: rights_of_supervisor(), RECORDER: rights_of_recorder(rights.values())}
