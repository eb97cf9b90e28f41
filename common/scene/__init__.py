"""The planning scene: what is fixed, and where an arm can take things from."""
