"""Fixtures of the planning tests."""

from collections.abc import Iterator

import pytest

from common.planning.kernel.library import library, without_kernel


@pytest.fixture
def no_kernel() -> Iterator[None]:
    """Compute as where the kernel was not built."""
    with without_kernel():
        yield


@pytest.fixture(params=["kernel", "coal"])
def backend(request: pytest.FixtureRequest) -> Iterator[str]:
    """Run the test with the kernel, and without it."""
    if request.param == "kernel":
        if library() is None:
            pytest.skip("the planning kernel is not built")
        yield "kernel"
    else:
        with without_kernel():
            yield "coal"
