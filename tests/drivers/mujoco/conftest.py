"""Tests of the world with physics need MuJoCo (extra `physics`); cached meshes are deleted afterwards."""

from pathlib import Path

import pytest

collect_ignore_glob: list[str] = []
try:
    import mujoco  # noqa: F401
except ImportError:
    collect_ignore_glob = ["test_*.py"]


@pytest.fixture(scope="session", autouse=True)
def mesh_cache_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("cache")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ZENCELL_CACHE", str(folder))
        yield folder
