"""A folder of certificates for both cells, created by `zencell secure init`."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from tests.harness import command_line, environment


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("secured") / "certificates"
    created = subprocess.run(
        command_line("secure", "init", str(folder)), env=environment(), umask=0, capture_output=True, text=True,
        timeout=100, check=False,
    )
    assert created.returncode == 0, created.stderr
    return folder
