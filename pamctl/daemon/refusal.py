"""What the daemon says no with."""

from __future__ import annotations


class RequestRefusedError(Exception):
    """A request that cannot be met in this state, or is wrong. It changed nothing."""
