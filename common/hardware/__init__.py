"""Hardware: the seam to an arm and its gripper (interface.py), and one file for each backend behind it."""
