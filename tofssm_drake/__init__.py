"""LeafSystems and their Diagrams for on-robot Time-of-Flight safety."""

__version__ = "0.1.0"
