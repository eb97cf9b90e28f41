"""The option `--ros2 [DOMAIN_ID]`: what it adds to a cell, checked before any process starts."""

from __future__ import annotations

import importlib.util
from collections.abc import Sequence

from common.config import find_file, read_yaml
from common.errors import ConfigError
from common.transport.credentials import secure_folder

SERVICE = "ros2_bridge"
HIGHEST_DOMAIN = 232  # of ROS 2
PACKAGES = ("rosbags", "xxhash")
EXTRA = "needs the extra `ros2`: pip install 'zencell[ros2]'"
OPEN_ONLY = "needs an open cell: rmw_zenoh has no certificates of zencell, and its keys no access rules"


def overrides_for(cell: str, domain: str | None) -> Sequence[str]:
    """Return the overrides of a cell that add the bridge, or give the one of the cell file this domain.

    Args:
        cell: name or path of its file.
        domain: ROS_DOMAIN_ID of the option; None without it.

    Raises:
        ConfigError: a package is missing, the domain is invalid, or the cell is secured.
        UnknownName: there is no such cell.
    """
    if domain is None:
        return ()
    if not (domain.isascii() and domain.isdigit() and int(domain) <= HIGHEST_DOMAIN):
        raise ConfigError("--ros2", domain, f"must be a whole number from 0 to {HIGHEST_DOMAIN}")
    require_usable("--ros2", domain)
    services = read_yaml(find_file("cells", cell)).get("services")
    if isinstance(services, dict) and SERVICE in services:
        return (f"services.{SERVICE}.domain={domain}",)
    return (f"services.{SERVICE}={{domain: {domain}}}",)


def require_usable(field: str, value: object) -> None:
    """Return if the packages of the extra are installed and the cell is open.

    Raises:
        ConfigError: a package is missing, with the extra; or the cell is secured.
    """
    if any(importlib.util.find_spec(name) is None for name in PACKAGES):
        raise ConfigError(field, value, EXTRA)
    if secure_folder() is not None:
        raise ConfigError(field, value, OPEN_ONLY)
