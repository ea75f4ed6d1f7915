"""Composition: scenarios, and the functions that make Diagrams."""
