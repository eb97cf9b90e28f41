"""The network, process and router fixtures of the transport tests."""

from tests.common.transport.conftest import (  # noqa: F401
    domain,
    new_bus,
    processes,
    shared_router,
    until_fixture,
)
