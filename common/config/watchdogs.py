"""How long silence is borne before something is done about it."""

from __future__ import annotations

from pydantic import Field

from common.config.basics import Section


class Watchdogs(Section):
    """Patience with processes that are alive and do nothing; wall time."""

    loop: float = Field(
        5.0, ge=0, le=600, description="a service whose event loop does not turn for so long ends itself; 0: never [s]"
    )
    silence: float = Field(
        7.0, ge=0, le=600, description="a process not heard of for so long is killed and started again; 0: never [s]"
    )
    start: float = Field(
        60.0, ge=5, le=600, description="one that is started again and not ready for so long is killed too [s]"
    )
