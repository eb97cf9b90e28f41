"""A cell as a program sees it: what `from zencell import Cell` gives, and what the command line stands on."""
