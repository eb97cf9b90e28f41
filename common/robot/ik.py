"""Moved: inverse kinematics is in common.planning.ik."""

from common.moved import moved_to

__getattr__ = moved_to(__name__, "common.planning.ik")
