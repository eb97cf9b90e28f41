"""Access tokens of the operator's page: one per role, in files of the folder that `zencell secure init` writes."""

from __future__ import annotations

import re
import secrets
from pathlib import Path

from common.errors import ConfigError

VIEWER = "viewer"  # kind of the service that serves the page
TOKEN_VARIABLE = "ZENCELL_VIEWER_TOKEN"  # an environment variable does not show up in a process list
MIN_TOKEN_LENGTH = 16  # characters
ROLES = ("look", "operate", "tune")  # view only; also move the robot; also change parameters
ALL_ROLES = frozenset(ROLES)
TOKEN_PATTERN = re.compile(rf"[A-Za-z0-9._~-]{{{MIN_TOKEN_LENGTH},}}")  # needs no escaping in a URL or a cookie


def make_token() -> str:
    """Return a random token of 256 bits that needs no escaping in a URL."""
    return secrets.token_urlsafe(32)


def token_file(folder: Path, cell: str, role: str) -> Path:
    """Return the path of the token file of one role for the page of a secured cell."""
    return folder / f"{cell}.page.{role}"


def read_tokens(folder: Path, cell: str) -> dict[str, str]:
    """Return the tokens of a secured cell's page by role; a role without a file is left out.

    Raises:
        ConfigError: a token file is readable by other users, cannot be read, or contains no valid token.
    """
    tokens = {}
    for role in ROLES:
        path = token_file(folder, cell, role)
        if not path.is_file():
            continue
        if path.stat().st_mode & 0o077:
            raise ConfigError("--secure", str(path), "is readable by other users: run chmod 600 on it")
        try:
            tokens[role] = path.read_text(encoding="ascii").strip()
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError("--secure", str(path), f"cannot be read: {error}") from None
        if not TOKEN_PATTERN.fullmatch(tokens[role]):
            raise ConfigError("--secure", str(path),
                              "contains no valid token: `zencell secure init DIR --renew` creates one")
    return tokens
