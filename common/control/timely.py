"""Whether a request comes in time: one that was under way for long, or is sent again by somebody, moves nothing."""

from __future__ import annotations

from common.errors import Refused

STALE, AHEAD = "stale_request", "clock_ahead"


def objection(age: float, longest: float, clock_tolerance: float) -> Refused | None:
    """What speaks against a request because of its age; None when nothing does.

    Args:
        age: since it was decided, by the clocks of both hosts; negative when that lies in the future [s, wall].
        longest: that it may take to arrive [s].
        clock_tolerance: how far the clocks may differ [s].
    """
    if age > longest:
        told = f"is {age:.1f} s old" if age < 1e6 else "does not say when it was decided (header.stamp)"
        return Refused(STALE, f"the request {told}: more than {longest:g} s, or the clocks differ")
    if age < -clock_tolerance:
        return Refused(AHEAD, f"the request comes from {-age:.1f} s ahead: the clock of who asks is wrong, or ours")
    return None
