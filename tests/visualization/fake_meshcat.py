"""Stands in for Meshcat where a test wants to see what was written."""


class FakeMeshcat:
    def __init__(self):
        self.objects = {}
        self.transforms = []
        self.properties = []

    def SetObject(self, path, shape, rgba):
        self.objects[path] = (shape, rgba)

    def SetTriangleMesh(self, path, vertices, faces, rgba):
        self.objects[path] = ((vertices, faces), rgba)

    def SetTransform(self, path, X_ParentPath, time_in_recording=None):
        self.transforms.append((path, X_ParentPath, time_in_recording))

    def SetProperty(self, path, property, value, time_in_recording=None):
        self.properties.append((path, property, value, time_in_recording))

    def find_last(self, path, name):
        """Returns the last value written to a property; None: never."""
        values = [v for p, n, v, _ in self.properties if (p, n) == (path, name)]
        return values[-1] if values else None
