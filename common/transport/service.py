"""Moved: the life of a service is in common.process.service."""

from common.moved import moved_to

__getattr__ = moved_to(__name__, "common.process.service")
