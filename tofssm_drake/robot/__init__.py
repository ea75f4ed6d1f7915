"""The UR10: kinematics, pick-and-place program, simulated controller."""
