"""Engine of every task: a queue of stages, planned ahead, monitored, and decided again after a failure or restart."""
