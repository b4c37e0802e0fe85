"""What is said of the rivals of a finding."""

import pytest

from pamctl.diagnose.evidence.ladder import JudgedRival
from pamctl.diagnose.evidence.measuring_chain import list_of_chain
from pamctl.diagnose.report.finding_words import describe_standing

LATE = next(list_of_chain(["position_m"], {}, 1e-3, "direct", {}))


@pytest.mark.parametrize(
    ("behind_nats", "is_beaten", "words"),
    [
        (62.0, True, "62 nats behind"),
        (14.0, False, "14 nats behind, which does not rule it out"),
        (-621.0, False, "621 nats ahead"),
    ],
)
def test_a_rival_is_behind_or_ahead_and_never_a_negative_number_behind(
    behind_nats: float, is_beaten: bool, words: str
) -> None:
    ends = (behind_nats - 5.0, behind_nats + 5.0)
    rival = JudgedRival(
        LATE, behind_nats, ends, 0.9, is_beaten, is_freer=False, is_better=False, model=None
    )
    assert describe_standing(rival) == words
