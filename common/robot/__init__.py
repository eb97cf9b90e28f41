"""The robot: model, kinematics, transforms."""
