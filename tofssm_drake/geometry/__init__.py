"""Ray casting and distances between shapes, on a Drake SceneGraph."""
