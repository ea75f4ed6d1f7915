"""Ground truth, metrics, audit."""
