"""Real robots and sensors, and their stand-ins on the same wires."""
