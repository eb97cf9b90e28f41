"""Device drivers: arms, grippers, depth cameras and the MuJoCo world, found by name."""
