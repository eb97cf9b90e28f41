"""Cells as groups of processes: starting, watching, restarting and stopping them."""
