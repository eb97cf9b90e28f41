"""The network, process and router fixtures of the transport tests."""

from tests.common.transport.conftest import domain, processes, shared_router  # noqa: F401
