"""Offscreen pictures of the robot with its meshes."""
