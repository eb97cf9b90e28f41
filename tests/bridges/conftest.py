"""A router for a bridge and the programs beyond it, and what a test has to close."""

from collections.abc import AsyncIterator, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import AsyncExitStack

import pytest
import zenoh

from common.transport.endpoint import endpoint_of, router_config
from tests.domains import free_domain


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    found = endpoint_of(free_domain())
    with ThreadPoolExecutor(1) as thread:  # this thread may already run a loop
        router = thread.submit(lambda: zenoh.open(router_config([found]))).result()
        yield found
        router.close()


@pytest.fixture
async def stack() -> AsyncIterator[AsyncExitStack]:
    async with AsyncExitStack() as stack:
        yield stack
