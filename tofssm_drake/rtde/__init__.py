"""UR robots: protocol, client, Drake systems, simulated robot."""
