"""What a cell has that does not come with the project, as far as a recording of it has to know."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from common.application import all_topics, import_topics
from common.config import Cell
from common.remapping import Remapping


@dataclass(frozen=True)
class Own:
    """Modules of a person's own, and keys under other names."""

    modules: tuple[str, ...] = ()
    renamed: tuple[Mapping[str, str], ...] = ()  # as common/remapping.py has it, by service

    @classmethod
    def of(cls, cell: Cell) -> Own:
        """That of a cell file."""
        services = cell.services.values()
        named = dict.fromkeys([cell.application, *(entry.module for entry in services)])
        own = (name for name in named if "." in name and not name.startswith("services."))
        return cls(tuple(own), tuple(entry.topics for entry in services if entry.topics))

    @classmethod
    def read(cls, text: str) -> Own:
        """What `str` wrote."""
        return cls(*(tuple(part) for part in json.loads(text)))

    def __str__(self) -> str:
        return json.dumps([self.modules, self.renamed])

    def topics(self) -> dict[str, Any]:
        """Every topic by its key before it is renamed; the messages of all modules are known from now on."""
        return {**all_topics(), **import_topics(self.modules)}

    def kinds(self, known: Mapping[str, Any]) -> dict[str, str]:
        """Kinds of topics by key in the cell."""
        kinds = {key: str(topic.kind) for key, topic in known.items()}
        return kinds | {Remapping(table).key(key): kind for table in self.renamed for key, kind in kinds.items()}
