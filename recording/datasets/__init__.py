"""Data sets for robot learning from recordings (extra `datasets`): LeRobot, robomimic, Parquet, numpy."""

from __future__ import annotations

import importlib
from typing import Any

from common.errors import ConfigError


def optional(package: str, option: str) -> Any:
    """Return a package of the extra `datasets`.

    Raises:
        ConfigError: it is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        advice = "needs the extra `datasets`: pip install 'zencell[datasets]'"
        raise ConfigError(option, ..., f"{advice} ({error})") from None
