"""Faults in cells of real processes: a seeded plan, and an agent that carries it out."""
