"""The life of a service process: start, readiness, health, log, parameters, and the runner of a task."""
