"""From light to a separation: ring, measurement model, mask, distance."""
