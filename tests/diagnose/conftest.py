"""What the tests of the diagnosis share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest


@pytest.fixture(scope="module", autouse=True)
def next_program(request: pytest.FixtureRequest) -> Iterator[None]:
    """Choose no program that decides what is left, but in `deciding/`.

    Of a diagnosis that leaves something open it takes most of the time.
    """
    with pytest.MonkeyPatch.context() as patch:
        if request.path.parent.name != "deciding":
            choose = "pamctl.diagnose.workflow.choose_deciding_program"
            patch.setattr(choose, lambda *_, **__: None)
        yield
