"""A robot file proposed for a URDF that nobody has set up: what is read, measured and guessed."""
