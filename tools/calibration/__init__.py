"""Calibrate cameras: intrinsics, pose in the cell, hand-eye."""
