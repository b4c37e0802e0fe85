"""`python -m pamctl.benchmark`: the hidden rigs as a benchmark for any method of diagnosis.

The rigs share no code with pamctl's plant. They are the package `hidden`: the folder `tests` of a
checkout, `pamctl/_rigs` of an installed pamctl.
"""

from __future__ import annotations

import sys
from importlib import import_module
from pathlib import Path
from typing import Any

from pamctl.realtime.scheduling import keep_single_threaded

_HERE = Path(__file__).parent
_PLACES = (_HERE.parent / "tests", _HERE / "_rigs")


def call_in_rigs(module: str, function: str, *arguments: Any) -> Any:
    """Call a function of the rigs' package; any process that can import pamctl can do so."""
    folder = next(place for place in _PLACES if (place / "hidden").is_dir())
    if str(folder) not in sys.path:
        sys.path.insert(0, str(folder))
    return getattr(import_module(module), function)(*arguments)


if __name__ == "__main__":
    keep_single_threaded()
    call_in_rigs("hidden.benchmark.command_line", "main")
