"""Hardware abstraction: volts and counts, and nothing of muscles."""
