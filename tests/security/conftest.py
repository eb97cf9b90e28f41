"""A folder of certificates for both cells, created by `zencell secure init`."""

import os
from pathlib import Path

import pytest

from tests.harness import ask


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    parent = tmp_path_factory.mktemp("secured")
    umask = os.umask(0)  # the modes of the files must not depend on it
    try:
        created = ask(parent, "secure", "init", "certificates")
    finally:
        os.umask(umask)
    assert created.returncode == 0, created.stderr
    return parent / "certificates"
