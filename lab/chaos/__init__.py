"""Faults on purpose: a seeded plan of them, and what carries it out in a running cell."""
