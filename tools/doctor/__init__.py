"""What a cell needs of the machine that it runs on, what is in its way, and what to do about it."""
