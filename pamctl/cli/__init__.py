"""The commands, and the composition root where backends are chosen."""
