"""The monitor's side of sensing: from scans to a separation."""
