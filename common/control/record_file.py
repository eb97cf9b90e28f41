"""The file in which what persons decided about motion outlives the executor, the supervisor and the machine."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from common.control.interlocks import Record, damaged
from common.errors import ConfigError
from common.kept_file import STATE_VARIABLE, KeptFile, Unreadable, lasting_folder


class RecordFile(KeptFile[Record]):
    """What is to be known before the robot moves: a file that cannot be read keeps it from moving."""

    def __init__(self, path: Path) -> None:
        """Use this file, which need not be there yet."""
        super().__init__(path, Record)

    def require_writable(self) -> None:
        """Return when the file can be written, from now on also on a disk that is full.

        Raises:
            ConfigError: it cannot.
        """
        try:
            record, problem = self.load()
            if not problem:  # else it stays to be looked at
                self.save(record)
            self.make_room(record)
        except OSError as error:
            told = f"cannot be written ({error.strerror or error}): stops and holds would not outlive a restart"
            raise ConfigError(STATE_VARIABLE, str(self.path.parent), told) from None

    def load(self) -> tuple[Record, str]:
        """The record, and what is wrong with the file: then the record is one that keeps the robot from moving."""
        try:
            return self.read(), ""
        except Unreadable as error:
            return damaged(f"{error.path}: {error.why}"), str(error)


def record_file(cell: str, environ: Mapping[str, str] = os.environ) -> RecordFile:
    """The file of a cell: of the same name wherever its executor runs.

    Raises:
        ConfigError: there is no home to keep it in.
    """
    return RecordFile(lasting_folder(environ) / f"{cell}.inhibits.json")
