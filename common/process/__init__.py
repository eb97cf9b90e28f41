"""The life of a process: start, readiness, health, log, parameters, and the runner of a task."""
