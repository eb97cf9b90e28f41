"""One line instead of a traceback for errors of the client that a script does not catch."""

from __future__ import annotations

import sys
import traceback
from pathlib import Path
from types import TracebackType

from common.errors import ZencellError

_PROJECT = str(Path(__file__).resolve().parents[2])


def install() -> None:
    """Report uncaught client errors, and Ctrl-C in a call of the client, in one line with the line of the script.

    Another hook, such as that of a notebook, stays.
    """
    if sys.excepthook is sys.__excepthook__:
        sys.excepthook = _report


def _report(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
    files = [(frame.filename, frame.lineno) for frame in traceback.extract_tb(trace)]
    inner = next((n for n, (name, _) in enumerate(files) if _is_of_project(name)), len(files))
    known = isinstance(error, ZencellError) or (isinstance(error, KeyboardInterrupt) and inner < len(files))
    own = [at for at in files[:inner] if not at[0].startswith((sys.base_prefix, "<"))]
    if not known or not own:
        sys.__excepthook__(kind, error, trace)
        return
    name, line = own[-1]
    text = f"{kind.__name__}: {error}" if isinstance(error, ZencellError) else "interrupted"
    sys.stderr.write(f"{name}:{line}: {text}\n")


def _is_of_project(file: str) -> bool:
    folder = Path(file).parts[len(Path(_PROJECT).parts):][:1]
    return file.startswith(_PROJECT) and folder in (("common",), ("zencell",))
