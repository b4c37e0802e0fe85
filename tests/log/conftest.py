"""What the tests of logs share."""

from __future__ import annotations

import pytest

from pamctl.log.importing import file_formats
from pamctl.log.importing.measured_table import ImportRefused


@pytest.fixture
def parsed_here(monkeypatch: pytest.MonkeyPatch) -> None:
    """Parse files of packages in this process: a process of its own costs a second a file."""

    def parse(*arguments):
        outcome = file_formats._parse_here(*arguments)
        if isinstance(outcome, str):
            raise ImportRefused(outcome)
        return outcome

    monkeypatch.setattr(file_formats, "_parse_apart", parse)
    monkeypatch.setattr(file_formats, "_limit_memory", lambda: None)
