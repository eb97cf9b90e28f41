"""The network, processes and routers that the tests of the transport have."""

from tests.common.transport.conftest import (  # noqa: F401
    domain,
    new_bus,
    processes,
    shared_router,
    until_fixture,
)
