"""From a separation to a speed fraction: the safety law."""
