"""Set up a robot, calibrate cameras, check cells and machines, draw the graph of a cell."""
