from collections.abc import Iterator
from pathlib import Path

import pytest
import viser

from page.server import close_server, make_server
from tests.page.scene_cell import Stage


@pytest.fixture(scope="module")
def server() -> Iterator[viser.ViserServer]:
    server = make_server("127.0.0.1", 0)
    yield server
    close_server(server)


@pytest.fixture
def gui(server: viser.ViserServer) -> viser.GuiApi:
    return server.gui


@pytest.fixture
def state_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty folder for saved state."""
    monkeypatch.setenv("ZENCELL_STATE", str(tmp_path))
    return tmp_path


@pytest.fixture
def panda(server: viser.ViserServer) -> Stage:
    return Stage(server, "panda")


@pytest.fixture
def ur5(server: viser.ViserServer) -> Stage:
    return Stage(server, "ur5")
