"""Proposes a robot file for a URDF: values are read, measured or guessed."""
