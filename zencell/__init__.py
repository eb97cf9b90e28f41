"""Robot work cells as a mesh of processes over Zenoh, and the client for programs: `from zencell import Cell`.

`import zencell` also makes the project's other modules importable. In a clone `common`, `services`, `cli` and `config`
are next to this package. In a wheel they are in a folder below it that is not a valid Python name, so that no module
can be imported under two names: docs/architecture.md, "Where modules live".
"""

from __future__ import annotations

import importlib
import sys
from pathlib import Path
from typing import TYPE_CHECKING

_WHEEL = Path(__file__).resolve().parent / "top-level"
_FOLDER = str(_WHEEL if _WHEEL.is_dir() else _WHEEL.parent.parent)

if _FOLDER not in sys.path:
    sys.path.insert(0, _FOLDER)

if TYPE_CHECKING:
    from common.client.cell import Cell
    from common.client.goals import Plan, any_of, pose, region, through
    from common.client.joining import NoCellRunning, NotStarted
    from common.client.operator_motion import JogFailed, MotionFailed
    from common.client.subscriptions import NothingReceived
    from common.errors import (
        ConfigError,
        NoResponder,
        RemoteError,
        RequestFailed,
        RequestLost,
        RequestTimeout,
        UnknownName,
        ZencellError,
    )
    from common.messages import Pose
    from recording.access import OpenRecording, open_recording
    from recording.sample import RecordingError
    from recording.tables import Table

_FROM = {  # imported at first use: the command line starts without them
    "common.client.cell": ("Cell",),
    "common.client.goals": ("Plan", "any_of", "pose", "region", "through"),
    "common.client.subscriptions": ("NothingReceived",),
    "common.client.joining": ("NoCellRunning", "NotStarted"),
    "common.errors": ("ConfigError", "NoResponder", "RemoteError", "RequestFailed", "RequestLost", "RequestTimeout",
                      "UnknownName", "ZencellError"),
    "common.messages": ("Pose",),
    "common.client.operator_motion": ("JogFailed", "MotionFailed"),
    "recording.access": ("OpenRecording", "open_recording"),
    "recording.sample": ("RecordingError",),
    "recording.tables": ("Table",),
}
_MODULE = {name: module for module, names in _FROM.items() for name in names}
# Names of earlier releases, for scripts that use them.
_FORMER = {"JogFailed": "JogFailed", "NothingReceived": "NothingReceived", "NoCellRunning": "NoCellRunning"}

__all__ = [
    "Cell",
    "ConfigError",
    "JogFailed",
    "MotionFailed",
    "NoCellRunning",
    "NoResponder",
    "NotStarted",
    "NothingReceived",
    "OpenRecording",
    "Plan",
    "Pose",
    "RecordingError",
    "RemoteError",
    "RequestFailed",
    "RequestLost",
    "RequestTimeout",
    "Table",
    "UnknownName",
    "ZencellError",
    "any_of",
    "open_recording",
    "pose",
    "region",
    "through",
]


def __getattr__(name: str) -> object:
    current = _FORMER.get(name, name)
    if current not in _MODULE:
        raise AttributeError(f"module 'zencell' has no attribute {name!r}")
    if name == "Cell":
        from common.client.uncaught import install

        install()
    return getattr(importlib.import_module(_MODULE[current]), current)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
