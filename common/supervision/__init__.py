"""Whole cells as processes: starting, watching, restarting and ending them, and the figures of a run."""
