"""Meshes to cast rays at, made and read without Drake."""

import itertools

import numpy as np
from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh

CUBE_VERTICES = 0.5 * np.array(
    [[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]
)
CUBE_QUADS = [
    [0, 1, 3, 2],
    [4, 6, 7, 5],
    [0, 4, 5, 1],
    [2, 3, 7, 6],
    [0, 2, 6, 4],
    [1, 5, 7, 3],
]
CUBE_FACES = np.array(
    [f for a, b, c, d in CUBE_QUADS for f in ([a, b, c], [a, c, d])]
)


def make_torus(count=16, major=0.5, minor=0.2):
    u, v = np.meshgrid(*2 * [2 * np.pi * np.arange(count) / count])
    ring = major + minor * np.cos(v)
    vertices = np.stack(
        [ring * np.cos(u), ring * np.sin(u), minor * np.sin(v)], -1
    ).reshape(-1, 3)
    i, j = np.divmod(np.arange(count * count), count)
    a = i * count + j
    b = i * count + (j + 1) % count
    c = (i + 1) % count * count + (j + 1) % count
    d = (i + 1) % count * count + j
    return vertices, np.vstack(
        [np.column_stack([a, b, c]), np.column_stack([a, c, d])]
    )


def write_obj(vertices, faces):
    lines = ["v {:.17g} {:.17g} {:.17g}".format(*v) for v in vertices]
    lines += [" ".join(["f", *(str(i + 1) for i in f)]) for f in faces]
    return "\n".join(lines)


def make_mesh(text, extension=".obj", scale=(1.0, 1.0, 1.0), kind=Mesh):
    file = MemoryFile(text, extension, "memory")
    return kind(InMemoryMesh(mesh_file=file), np.array(scale))


def read_mesh(shape):
    """Returns (vertices, faces) of what `make_mesh` has made."""
    rows = {"v": [], "f": []}
    text = shape.source().in_memory().mesh_file.contents().decode()
    for line in text.splitlines():
        kind, *numbers = line.split()
        rows[kind].append([float(number) for number in numbers])
    faces = np.array(rows["f"], dtype=int) - 1
    return np.array(rows["v"]) * np.asarray(shape.scale3()), faces


def make_stone(rng, size=0.3):
    """An octahedron, each face parted in four, with random radii: a closed
    surface that is not convex."""
    vertices = [*np.eye(3), *-np.eye(3)]
    middles = {}

    def find_middle(i, j):
        key = min(i, j), max(i, j)
        if key not in middles:
            middles[key] = len(vertices)
            middle = vertices[i] + vertices[j]
            vertices.append(middle / np.linalg.norm(middle))
        return middles[key]

    faces = []
    for x, y, z in itertools.product((0, 3), (1, 4), (2, 5)):
        # Turned out: an odd number of mirrors turns a triangle over.
        turned = (x + y + z) % 2 == 0
        a, b, c = (x, z, y) if turned else (x, y, z)
        ab, bc, ca = find_middle(a, b), find_middle(b, c), find_middle(c, a)
        faces += [[a, ab, ca], [ab, b, bc], [ca, bc, c], [ab, bc, ca]]
    radii = size * rng.uniform(0.4, 1.0, (len(vertices), 1))
    return np.array(vertices) * radii, np.array(faces)


def find_hull_planes(points):
    """All planes through three points with every point on one side."""
    i, j, k = np.array(list(itertools.combinations(range(len(points)), 3))).T
    n = np.cross(points[j] - points[i], points[k] - points[i])
    n /= np.linalg.norm(n, axis=1, keepdims=True)
    h = (n * points[i]).sum(-1)
    height = n @ points.T - h[:, None]
    below = (height < 1e-9).all(axis=1)
    above = (height > -1e-9).all(axis=1)
    planes = np.column_stack([n, h])
    return np.vstack([planes[below], -planes[above & ~below]])
