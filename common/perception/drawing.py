"""Moved: pictures of a simulated world are drawn in common.sim.drawing."""

from common.moved import moved_to

__getattr__ = moved_to(__name__, "common.sim.drawing")
