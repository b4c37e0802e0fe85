"""The real-time controller daemon of a pneumatic artificial muscle rig.

The rooms are layers: [tool.importlinter] in pyproject.toml lists them from top to bottom.
Read `realtime/tick.py` first: one step from a sample to a decision.
"""

__version__ = "0.1.0"
