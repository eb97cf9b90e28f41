"""The rig that the tests of the hardware have."""

from tests.common.hardware.conftest import limits, rest_to_rest, rig  # noqa: F401
