"""`from zencell.blocking import Cell`: the client without `await`, for scripts and notebooks."""

from common.client import uncaught
from common.client.blocking import Cell

uncaught.install()

__all__ = ["Cell"]
