"""What accuracy costs: time to reach it, dB per minute, which method to pay for."""
