"""A device that fails is a state with a reason: it is left alone for a while, longer each time, and told of once."""

from __future__ import annotations

from collections.abc import Callable
from typing import ParamSpec, TypeVar

from common.errors import Refused
from common.hardware.interface import HardwareFault
from common.messages.basics import clean

SHORTEST, LONGEST = 0.2, 5.0  # cell time for which a device that failed is left alone [s]
CALM = 2.0  # cell time that it works, after which all is forgotten [s]

P = ParamSpec("P")
T = TypeVar("T")


def asked(doing: str, call: Callable[P, T], *args: P.args, **kwargs: P.kwargs) -> T:
    """What a backend answers.

    Raises:
        HardwareFault: it raised something, of whatever type.
    """
    try:
        return call(*args, **kwargs)
    except Exception as error:
        told = clean(str(error))  # what a device says of itself may be anything
        if isinstance(error, HardwareFault) and told:
            raise HardwareFault(told) from error
        said = told.partition("\n")[0]
        raise HardwareFault(f"{doing}: {type(error).__name__}{': ' if said else ''}{said}") from error


class Fault:
    """Whether a device works; times are cell time [s]."""

    def __init__(self, device: str) -> None:
        """It works."""
        self.device, self.reason = device, ""
        self._until = self._since = -float("inf")
        self._pause = 0.0
        self._told = ""

    def waits(self, now: float) -> bool:
        """Whether it is to be left alone."""
        return bool(self.reason) and now < self._until

    def failed(self, reason: str, now: float) -> None:
        """It failed: leave it alone, twice as long as the last time."""
        calm = not self.reason and now - self._since >= CALM
        self._pause = SHORTEST if calm else min(max(2 * self._pause, SHORTEST), LONGEST)
        self.reason, self._until = reason, now + self._pause

    def works(self, now: float) -> None:
        """It did what it was asked."""
        if self.reason:
            self.reason, self._since = "", now

    @property
    def objection(self) -> Refused | None:
        """What speaks against asking something of it."""
        return Refused("hardware_fault", self.reason) if self.reason else None

    def news(self) -> str:
        """A line when it began or ceased to fail, or fails for another reason, since the last call; else empty."""
        if self.reason == self._told:
            return ""
        before, self._told = self._told, self.reason
        return f"{self.device} does not work: {self.reason}" if self.reason else f"{self.device} works again ({before})"
