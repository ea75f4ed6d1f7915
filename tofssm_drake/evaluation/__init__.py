"""Ground truth, records, metrics and the report of a run."""
