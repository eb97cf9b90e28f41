"""The engine of every task: rows of stages, planning ahead, watching, hold and stop, failure, restart."""
