"""Records which fields of a configuration are read, in the original and in copies made after `begin`."""

from __future__ import annotations

from typing import Any

import pytest

from common.config import Parameters, Section
from common.config.tunables import leaves


class Watch:
    """What is read of a configuration. A copy that was taken before `begin` counts as copied away."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, config: Parameters, service: str) -> None:
        self.read: set[str] = set()
        self.tunable = {path for path, leaf in leaves(config, service).items() if leaf.runtime}
        self._models: dict[int, tuple[Any, str]] = {}  # references, so that no other model gets the same id
        self._copies: list[int] = []
        for path, leaf in leaves(config, service).items():
            self._models[id(leaf.owner)] = (leaf.owner, path.rpartition(".")[0])
        for kind in (Parameters, Section):
            monkeypatch.setattr(kind, "__getattribute__", self._getting(object.__getattribute__), raising=False)
            monkeypatch.setattr(kind, "__copy__", self._copying(kind.__copy__))

    def _getting(self, get: Any) -> Any:
        def getting(model: Any, name: str) -> Any:
            known = self._models.get(id(model))
            if known is not None:
                self.read.add(f"{known[1]}.{name}")
            return get(model, name)

        return getting

    def _copying(self, copy: Any) -> Any:
        def copying(model: Any) -> Any:
            made = copy(model)
            known = self._models.get(id(model))
            if known is not None:
                self._models[id(made)] = (made, known[1])
                self._copies.append(id(made))
            return made

        return copying

    def begin(self) -> None:
        """Forget what was read so far; copies that exist now do not count from here on."""
        for copied in self._copies:
            self._models[copied] = (self._models[copied][0], "an old copy of ")
        self._copies.clear()
        self.read.clear()
