"""Words in Meshcat, which draws shapes only: panels with a texture."""

import io

from pydrake.common import MemoryFile
from pydrake.geometry import InMemoryMesh, Mesh, Rgba

BOARD = Rgba(0.20, 0.21, 0.23, 1.0)
"""Colour of the panels, and of the boards that they lie on."""

_DPI = 160
_FONT_SIZE = 0.66
"""Over the height of the panel; capitals are about half as high."""


def make_sign(
    text: str, *, width: float, height: float, rgba: Rgba, align: str = "center"
) -> Mesh:
    """Makes a flat panel with a line of text.

    Args:
        text: What it says.
        width: Of the panel, m.
        height: Of the panel, m.
        rgba: Colour of the text.
        align: left, center or right.

    Returns:
        A mesh in the y-z plane, centred on the origin. It is read along +y
        with z up, as seen from +x.
    """
    y, z = width / 2, height / 2
    obj = (
        "mtllib sign.mtl\nusemtl sign\n"
        f"v 0 {-y} {-z}\nv 0 {y} {-z}\nv 0 {y} {z}\nv 0 {-y} {z}\n"
        "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\nvn 1 0 0\n"
        "f 1/1/1 2/2/1 3/3/1 4/4/1\n"
    )
    mtl = "newmtl sign\nKd 1 1 1\nKs 0 0 0\nmap_Kd sign.png\n"
    png = _draw_text(text, width / height, rgba, align)
    return Mesh(
        InMemoryMesh(
            mesh_file=MemoryFile(obj.encode(), ".obj", "sign.obj"),
            supporting_files={
                "sign.mtl": MemoryFile(mtl.encode(), ".mtl", "sign.mtl"),
                "sign.png": MemoryFile(png, ".png", "sign.png"),
            },
        )
    )


def _draw_text(text, aspect, rgba, align):
    """Returns a PNG file's content, one inch high."""
    # Takes long to load; not everybody who draws writes.
    from matplotlib.figure import Figure

    figure = Figure(figsize=(aspect, 1.0), facecolor=_to_tuple(BOARD))
    figure.text(
        {"left": 0.0, "center": 0.5, "right": 1.0}[align],
        0.5,
        text,
        color=_to_tuple(rgba),
        fontsize=72 * _FONT_SIZE,
        fontweight="bold",
        ha=align,
        va="center_baseline",
    )
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=_DPI, metadata={"Software": None})
    return buffer.getvalue()


def _to_tuple(rgba):
    return rgba.r(), rgba.g(), rgba.b(), rgba.a()
