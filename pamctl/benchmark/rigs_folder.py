"""Where the hidden rigs are, and how to call them.

The rigs share no code with pamctl's plant. They are the package `hidden`: the folder `tests` of a
checkout, `pamctl/_rigs` of an installed pamctl.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

_HERE = Path(__file__).parents[1]
_PLACES = (_HERE.parent / "tests", _HERE / "_rigs")


def call_in_rigs(module: str, function: str, *arguments: Any) -> Any:
    """Call a function of the rigs' package; any process that can import pamctl can do so."""
    folder = next(place for place in _PLACES if (place / "hidden").is_dir())
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    return getattr(import_module(module), function)(*arguments)
