"""Records which tunable parameters services read, in their configuration and in copies made after `begin`."""

from __future__ import annotations

from typing import Any

import pytest

from common.config import Parameters, Section
from common.config.tunables import leaves


class Watch:
    """The read parameters of configurations. Reading a copy made before `begin` does not count."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.read: set[str] = set()
        self.tunable: set[str] = set()
        self._models: dict[int, tuple[Any, str]] = {}  # references, so that no other model gets the same id
        self._copies: list[int] = []
        for kind in (Parameters, Section):
            monkeypatch.setattr(kind, "__getattribute__", self._recording(object.__getattribute__), raising=False)
            monkeypatch.setattr(kind, "__copy__", self._following(kind.__copy__))

    def add(self, config: Parameters, service: str) -> None:
        """Watch the configuration of a service."""
        for path, leaf in leaves(config, service).items():
            self._models[id(leaf.owner)] = (leaf.owner, path.rpartition(".")[0])
            if leaf.runtime:
                self.tunable.add(path)

    def _recording(self, get: Any) -> Any:
        def recorded(model: Any, name: str) -> Any:
            known = self._models.get(id(model))
            if known is not None:
                self.read.add(f"{known[1]}.{name}")
            return get(model, name)

        return recorded

    def _following(self, copy: Any) -> Any:
        def followed(model: Any) -> Any:
            made = copy(model)
            known = self._models.get(id(model))
            if known is not None:
                self._models[id(made)] = (made, known[1])
                self._copies.append(id(made))
            return made

        return followed

    def begin(self) -> None:
        """Forget what was read so far."""
        for copied in self._copies:
            self._models[copied] = (self._models[copied][0], "an old copy of ")
        self._copies.clear()
        self.read.clear()
