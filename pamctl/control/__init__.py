"""Reference trajectories, filters and control laws."""
