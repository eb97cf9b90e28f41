"""The planning scene: fixed and added solids, and the workspace in which an arm can grasp."""
