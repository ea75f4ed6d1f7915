"""Geometry of the cell: models found through package.xml."""
