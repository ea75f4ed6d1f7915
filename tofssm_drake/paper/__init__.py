"""The experiment of 2019: its cells, claims, explanations, figures."""
