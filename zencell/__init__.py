"""Robot work cells as a mesh of processes over Zenoh, and the client for programs: `from zencell import Cell`.

After `import zencell` the project's modules can be imported, too. In a clone `common`, `services`, `cli` and `config`
lie beside this package. In a wheel they lie below it, in a folder whose name is no Python name, so that no module has a
second name there: docs/architecture.md, "Where modules live".
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
    from common.client.arm import JogFailed
    from common.client.cell import Cell
    from common.client.goals import Plan, any_of, pose, region, through
    from common.client.joining import NoCellRunning
    from common.client.operator_motion import MotionFailed
    from common.client.starting import NotStarted
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

_FROM = {  # imported when they are asked for: the command line starts without them
    "common.client.arm": ("JogFailed",),
    "common.client.cell": ("Cell",),
    "common.client.goals": ("Plan", "any_of", "pose", "region", "through"),
    "common.client.subscriptions": ("NothingReceived",),
    "common.client.joining": ("NoCellRunning",),
    "common.client.starting": ("NotStarted",),
    "common.errors": ("ConfigError", "NoResponder", "RemoteError", "RequestFailed", "RequestLost", "RequestTimeout",
                      "UnknownName", "ZencellError"),
    "common.messages": ("Pose",),
    "common.client.operator_motion": ("MotionFailed",),
}
_WHERE = {name: module for module, names in _FROM.items() for name in names}

__all__ = [
    "Cell",
    "ConfigError",
    "JogFailed",
    "MotionFailed",
    "NoCellRunning",
    "NoResponder",
    "NotStarted",
    "NothingReceived",
    "Plan",
    "Pose",
    "RemoteError",
    "RequestFailed",
    "RequestLost",
    "RequestTimeout",
    "UnknownName",
    "ZencellError",
    "any_of",
    "pose",
    "region",
    "through",
]


def __getattr__(name: str) -> object:
    if name not in _WHERE:
        raise AttributeError(f"module 'zencell' has no attribute {name!r}")
    return getattr(importlib.import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return [*globals(), *__all__]
