"""A cell session at a terminal: check the options, start the cell, show it, run its task, shut it down."""
