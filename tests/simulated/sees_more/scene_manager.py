"""The pick-and-place cell's scene keeper, which sees more."""

from services.scene_manager import Config, run
from tests.simulated.sees_more import seeing

__all__ = ["Config", "run"]
run = seeing(run)
