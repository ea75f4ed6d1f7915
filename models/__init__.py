"""Geometry of the cell: models found through package.xml."""

import importlib.resources
import pathlib

PACKAGE = "tofssm_drake_models"
"""Name of the model package: `package://tofssm_drake_models/...`."""


def find_package_xml() -> pathlib.Path:
    """Returns the path of this package's `package.xml`."""
    return pathlib.Path(
        str(importlib.resources.files("tofssm_drake.models") / "package.xml")
    )


def make_parser(plant, *, scene_graph=None):
    """Makes a strict parser that knows this project's models.

    Args:
        plant: The MultibodyPlant to parse into.
        scene_graph: The SceneGraph to register with, unless the plant is
            registered already.

    Returns:
        A `pydrake.multibody.parsing.Parser`: unknown tags are errors.
    """
    from pydrake.multibody.parsing import Parser

    parser = Parser(plant=plant, scene_graph=scene_graph)
    parser.SetStrictParsing()
    parser.package_map().AddPackageXml(str(find_package_xml()))
    return parser
