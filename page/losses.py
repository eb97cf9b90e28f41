"""What the page cannot know any more: who does not answer, and since when."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

BLINK = 1.0  # [s] for which somebody may be gone before that is told
MOST = 100  # services that are remembered when they are gone: anybody may make up names
NAMED = 8  # of them in a line


@dataclass(frozen=True)
class Loss:
    """Something is lost: in words, since when [s, monotonic], and which parts of the page tell of before now."""

    what: str
    since: float
    unknown: frozenset[str] = frozenset()


class Losses:
    """Remembers who was there. What never was is not lost: it is still being started."""

    def __init__(self) -> None:
        self._seen: set[str] = set()
        self._gone: dict[str, float] = {}  # since when [s]

    def update(
        self, connected: bool, alive: Iterable[str], answers: dict[str, tuple[str, bool]], now: float
    ) -> list[Loss]:
        """What is lost at a time.

        Args:
            connected: whether the router is reached.
            alive: services that are ready.
            answers: parts of the page, each with what that means when nobody answers for it, and whether somebody does.
            now: wall time [s], monotonic.
        """
        there = {"": connected, **({} if not connected else {
            **dict.fromkeys(self._seen - {"", *(f"/{part}" for part in answers)}, False),
            **dict.fromkeys(alive, True), **{f"/{part}": answer for part, (_, answer) in answers.items()}})}
        for name, is_there in there.items():
            if is_there:
                self._seen.add(name)
                self._gone.pop(name, None)
            elif name in self._seen:
                self._gone.setdefault(name, now)
        for name in sorted(self._gone, key=self._gone.__getitem__)[: max(0, len(self._gone) - MOST)]:
            del self._gone[name]
            self._seen.remove(name)
        gone = {name: since for name, since in self._gone.items() if now - since >= BLINK or name == ""}
        if not connected:
            since = gone.get("", now)
            return [Loss("No connection to the router of the cell: nothing here is of now, and nobody can be asked",
                         since, frozenset({"all"}))]
        names = sorted(name for name in gone if not name.startswith("/"))
        parts = {part: gone[f"/{part}"] for part in answers if f"/{part}" in gone}
        lost = [Loss(answers[part][0], since, frozenset({part})) for part, since in parts.items()]
        if names:
            does = "does" if len(names) == 1 else "do"
            more = f" and {len(names) - NAMED} more" if len(names) > NAMED else ""
            lost.append(Loss(f"{', '.join(names[:NAMED])}{more} {does} not answer", min(gone[name] for name in names)))
        return lost
