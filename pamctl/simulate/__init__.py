"""Simulate whole runs without processes: tick and plant, compiled.

`merit.py` has the figures of merit that all pages and tables use.
Read `closed_loop.py` first.
"""

import sys
from importlib import import_module
from types import ModuleType
from typing import Any


class CallableRoom(ModuleType):
    """The room, which can also be called: `pamctl.simulate(...)` is for users of a session."""

    def __call__(self, *arguments: Any, **options: Any) -> Any:
        """Simulate a rig: see `pamctl.session.simulated_rig.simulate`."""
        return import_module("pamctl.session.simulated_rig").simulate(*arguments, **options)


# Once this room is imported, Python sets the name `pamctl.simulate` to it.
sys.modules[__name__].__class__ = CallableRoom
