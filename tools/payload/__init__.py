"""Identify the payload of an arm from forces at rest in several orientations."""
