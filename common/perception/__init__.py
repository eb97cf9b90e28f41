"""Pictures in, positions out: pure functions of arrays and a camera."""
