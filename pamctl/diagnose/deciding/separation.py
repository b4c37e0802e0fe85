"""Stub."""

from dataclasses import dataclass


@dataclass(frozen=True)
class Separation:
    """What one explanation leaves of a run where another is true."""

    true: str
    refuted: str
    block: str
    """The block that shows it best."""
    residual_over_floor: float
    """1 where the run does not separate the two."""
    sureness: float
    """Above 1, the rule that judges rivals would refute it, by this run and the records so far."""

    @property
    def is_decided(self) -> bool:
        """Whether the wrong one would be refuted."""
        return self.sureness > 1.0
