"""One process each: a thin shell that declares, is ready, loops, asks and publishes. What it thinks is in common/."""
