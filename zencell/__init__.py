"""Robot work cells as a mesh of processes over Zenoh; after `import zencell` the project's modules can be imported.

In a clone `common`, `services`, `cli` and `config` lie beside this package. In a wheel they lie below it, in a folder
whose name is no Python name, so that no module has a second name there: docs/architecture.md, "Where modules live".
"""

import sys
from pathlib import Path

_WHEEL = Path(__file__).resolve().parent / "top-level"
_FOLDER = str(_WHEEL if _WHEEL.is_dir() else _WHEEL.parent.parent)

if _FOLDER not in sys.path:
    sys.path.insert(0, _FOLDER)
