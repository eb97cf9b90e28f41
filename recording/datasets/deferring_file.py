"""File that reports write errors later: HDF5 ends the process with a segmentation fault after one on a full disk."""

from __future__ import annotations

import io
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from typing_extensions import Buffer


class DeferringFile(io.FileIO):
    """New file that discards what does not fit on the disk; `check()` raises the first error."""

    def __init__(self, path: Path) -> None:
        """Create the file."""
        super().__init__(path, "w+")
        self._error: OSError | None = None

    def write(self, data: Buffer, /) -> int:
        """Write all bytes, or remember why not."""
        rest = memoryview(data).cast("B")
        size = len(rest)
        while self._error is None and len(rest):
            try:
                rest = rest[super().write(rest) :]
            except OSError as error:
                self._error = error
        return size

    def truncate(self, size: int | None = None, /) -> int:
        """Change the size, or remember why not."""
        try:
            return super().truncate(size)
        except OSError as error:
            self._error = self._error or error
            return 0

    def check(self) -> None:
        """Return if all was written.

        Raises:
            OSError: the first error.
        """
        if self._error is not None:
            raise self._error
