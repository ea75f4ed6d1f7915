"""Rays against any SceneGraph."""
