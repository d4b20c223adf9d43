"""Robots on ground: physics, terrain, what is measured of them, and what is drawn for each."""
