"""Outlining: the tool traces the outline of an object that a depth camera saw."""

TASK = "contour_tracer"
