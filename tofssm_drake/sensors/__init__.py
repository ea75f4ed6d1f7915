"""The world's side of sensing: Time-of-Flight rings, planar lidar."""
