"""Grasps tried in physics without an arm, and a scorer learned from them."""
