"""Unitree G1 with 29 degrees of freedom: constants, MuJoCo model, kinematics and nominal poses."""
