"""The equations of the rigs and their integration, kernel by kernel."""
