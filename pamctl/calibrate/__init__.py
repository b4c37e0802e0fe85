"""Guided calibration: dated values, with how they were found and how good they are."""
