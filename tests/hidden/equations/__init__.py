"""The equations of the rigs and their integration, by compiled steps."""
