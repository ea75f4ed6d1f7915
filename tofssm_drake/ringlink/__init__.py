"""Real rings: frames, receiver, Drake systems, simulated devices."""
