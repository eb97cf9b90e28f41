"""Teleoperation with a keyboard, gamepad or 3D mouse, and recording of demonstrations."""
