"""A world with physics, by MuJoCo (extra `physics`)."""
