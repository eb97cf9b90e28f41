"""When which message of a recording is due: rate, pause, steps and jumps, on a clock that the caller reads."""

from __future__ import annotations


class Playhead:
    """Where a playback is. Log times and the wall clock are both in ns since the Unix epoch."""

    def __init__(self, position: int, now: int, *, rate: float = 1.0, paused: bool = False) -> None:
        """Begin at a log time.

        Args:
            position: log time to begin at.
            now: wall clock.
            rate: seconds of recording per second.
            paused: wait to be resumed.
        """
        self.rate = rate
        self._position = position  # that was due at _since
        self._since = now
        self._paused = paused

    @property
    def paused(self) -> bool:
        """Whether nothing is due until it is resumed."""
        return self._paused

    def position(self, now: int) -> int:
        """Log time that is due now."""
        return self._position if self._paused else self._position + round((now - self._since) * self.rate)

    def due(self, log_time: int) -> int:
        """Wall clock at which a log time is due, were there no further pause."""
        return self._since + round((log_time - self._position) / self.rate)

    def pause(self, now: int) -> None:
        """Stand still from now on."""
        self._position = self.position(now)
        self._since = now
        self._paused = True

    def resume(self, now: int) -> None:
        """Go on from where it stands."""
        self._since = now
        self._paused = False

    def jump(self, position: int, now: int) -> None:
        """Be at a log time now; whether it is paused does not change."""
        self._position = position
        self._since = now
