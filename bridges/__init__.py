"""Servers that show a cell to programs of other makers."""
