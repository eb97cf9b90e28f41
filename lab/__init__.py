"""Whole cells in one process on a virtual clock, where a seed decides the order of everything, faults included."""
