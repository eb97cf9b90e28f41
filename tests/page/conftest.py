from collections.abc import Iterator

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
def panda(server: viser.ViserServer) -> Stage:
    return Stage(server, "panda")


@pytest.fixture
def ur5(server: viser.ViserServer) -> Stage:
    return Stage(server, "ur5")
