"""Motions of several arms next to each other: proofs over time, and the order of motions. Pure."""
