"""The stamp of a message, read without decoding the message; and figures of the delays that stamps tell."""

from __future__ import annotations

from collections import deque

import msgpack

HEAD = 256  # [bytes] in which the header of our messages lies; what follows may be a picture
COVERED = 5.0  # [s] before now that the figures cover, at most

DelayFigures = dict[str, float | int | None]


def stamp_of(payload: bytes) -> int | None:
    """The cell time [ns] in a message's header, or in that of its first transform; None where there is none."""
    for part in (payload[:HEAD], payload):
        unpacker = msgpack.Unpacker(raw=False, strict_map_key=False, max_buffer_size=len(payload) + 1)
        unpacker.feed(part)
        try:
            return _stamp_in(unpacker)
        except msgpack.OutOfData:
            continue
        except (ValueError, TypeError, msgpack.UnpackException):  # not a message
            return None
    return None


def _stamp_in(unpacker: msgpack.Unpacker) -> int | None:
    for _ in range(unpacker.read_map_header()):
        match unpacker.unpack():
            case "header":
                header = unpacker.unpack()
                stamp = header.get("stamp") if isinstance(header, dict) else None
                return stamp if isinstance(stamp, int) and stamp > 0 else None
            case "transforms":  # TFMessage has one header for each transform
                return _stamp_in(unpacker) if unpacker.read_array_header() else None
            case _:
                unpacker.skip()
    return None


class Delays:
    """How old messages were when they came."""

    def __init__(self) -> None:
        """Nothing came yet."""
        self.total = 0
        self._recent: deque[tuple[float, float]] = deque()  # when it came [s], how old it was [ms]

    def add(self, now: float, delay: float) -> None:
        """Take note of a message that came at a time [s] with an age [ms]."""
        self.total += 1
        self._recent.append((now, delay))

    def figures(self, now: float) -> DelayFigures:
        """Mean, least, most, median and 99th percentile of what came lately [ms]; None where nothing did."""
        while self._recent and self._recent[0][0] < now - COVERED:
            self._recent.popleft()
        delays = sorted(delay for _, delay in self._recent)
        if not delays:
            return {"messages": self.total, "mean": None, "min": None, "max": None, "p50": None, "p99": None}
        return {
            "messages": self.total,
            "mean": round(sum(delays) / len(delays), 3),
            "min": round(delays[0], 3),
            "max": round(delays[-1], 3),
            "p50": round(_quantile(delays, 0.5), 3),
            "p99": round(_quantile(delays, 0.99), 3),
        }


def _quantile(ordered: list[float], fraction: float) -> float:
    """The value below which a fraction of the values lies, interpolated between neighbours."""
    place = fraction * (len(ordered) - 1)
    low = int(place)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (ordered[high] - ordered[low]) * (place - low)
