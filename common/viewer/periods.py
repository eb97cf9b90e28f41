"""How often each part of the page is brought up to date."""

from __future__ import annotations

from dataclasses import dataclass, field


@dataclass
class Periods:
    """Wall time between two looks at a part of the page [s]."""

    picture: float = 0.1
    task: float = 0.2
    health: float = 0.25
    plots: float = 0.5
    frustum: float = 0.5
    contours: float = 0.5
    detected: float = 0.5
    _due: dict[str, float] = field(default_factory=dict)

    def due(self, part: str, now: float) -> bool:
        """Whether it is time for a part at a wall time [s]; it is done then."""
        if now < self._due.get(part, 0.0):
            return False
        self._due[part] = now + float(getattr(self, part))
        return True

    def hurry(self) -> None:
        """Have it be time for everything: somebody has come who has seen nothing yet."""
        self._due.clear()
