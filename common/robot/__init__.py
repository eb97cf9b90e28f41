"""The robot: description, kinematics, gripper, frames and meshes."""
