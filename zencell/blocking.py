"""`from zencell.blocking import Cell`: the client without `await`, for scripts and notebooks."""

from common.client.blocking import Cell

__all__ = ["Cell"]
