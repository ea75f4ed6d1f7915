"""What a run leaves behind: samples, scans, reports."""
