"""Is this PC, and is this rig, fit for a run: findings, each with its fix."""
