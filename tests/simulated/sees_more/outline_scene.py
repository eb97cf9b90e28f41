"""The outlining cell's scene keeper, which sees more."""

from services.outline_scene import Config, run
from tests.simulated.sees_more import seeing

__all__ = ["Config", "run"]
run = seeing(run)
