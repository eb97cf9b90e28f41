"""Simulation of complete cells on virtual time, with injected faults and checked invariants; chaos in real cells."""
