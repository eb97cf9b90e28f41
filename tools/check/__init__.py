"""What will not work in a cell, told from its files alone: before anything moves, without a process or a network."""
