"""Command line: arguments and a run loop, nothing else."""
