"""The robot arm: model, kinematics, simulated controller."""
