"""`episodes.json`: the episodes of a folder; `zencell demo record` writes it, `zencell export` reads it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from common.config import check
from common.errors import ConfigError

NAME = "episodes.json"


class Demonstration(BaseModel):
    """One recorded episode. Discarded ones have no entry, and no file."""

    model_config = ConfigDict(extra="forbid")

    file: Annotated[str, Field(pattern=r"^[^/\\\x00-\x1f]+\.mcap$", description="in the folder of the manifest")]
    success: bool
    task: Annotated[str, Field(max_length=1000)]
    seed: int | None = Field(None, ge=0, description="of the cell; null: that of its file")


class Manifest(BaseModel):
    """The episodes of a folder, in the order of their recording."""

    model_config = ConfigDict(extra="forbid")

    cell: str
    episodes: list[Demonstration] = []


def read_manifest(folder: Path) -> Manifest:
    """Return the manifest of a folder.

    Raises:
        ConfigError: it is missing, or not valid.
    """
    path = folder / NAME
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise ConfigError(str(folder), ..., f"is a folder without {NAME}, which `zencell demo record` writes") from None
    except (OSError, ValueError, RecursionError) as error:
        raise ConfigError(str(path), ..., f"cannot be read: {error}") from None
    return check(Manifest, values, str(path))


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Replace the manifest of a folder at once: a kill leaves the old or the new one."""
    part = folder / f".{NAME}.part"
    part.write_text(manifest.model_dump_json(indent=2) + "\n", encoding="utf-8")
    part.replace(folder / NAME)
