"""Real-time controller daemon of a pneumatic artificial muscle rig."""

__version__ = "0.1.0"
