"""A cell as programs see it: `from zencell import Cell`, and the basis of the command line."""
