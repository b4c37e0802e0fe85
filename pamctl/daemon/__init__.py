"""The service: a rig that stays up, is steered and watched while it runs."""
