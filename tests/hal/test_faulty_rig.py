"""Each fault spoils only its own signal, from its tick on, for its number of ticks."""

import math

import pytest

from hal.faulty import FaultSettings, FaultyRig
from hal.rig import RawSample, RigError, RigIdentity

TICKS = 12
FROM, LASTS = 4, 3
DUE = range(FROM, FROM + LASTS)


class CountingRig:
    """Every sample differs from every other in every channel."""

    def __init__(self) -> None:
        self.reads = -1
        self.written: list[float] = []
        self.calls: list[str] = []

    def open(self) -> None:
        self.reads = -1
        self.calls.append("open")

    def read(self) -> RawSample:
        self.reads += 1
        return good(self.reads)

    def write(self, ao_v: float) -> float:
        self.written.append(ao_v)
        return ao_v + 0.125

    def make_safe(self) -> None:
        self.calls.append("make_safe")

    @property
    def safe_failure(self) -> RigError | None:
        return None

    def close(self) -> None:
        self.calls.append("close")

    def describe(self) -> RigIdentity:
        return RigIdentity("counting", 0.0)


def good(tick: int) -> RawSample:
    return RawSample(0.5 + 0.01 * tick, 100 + 7 * tick, 1000 * tick, 1000 * tick + 10)


def fault(kind: str, size: float = 0.0, from_tick: int = FROM, ticks: int = LASTS) -> FaultSettings:
    return FaultSettings(kind=kind, from_tick=from_tick, ticks=ticks, size=size)


def samples(*faults: FaultSettings) -> list[RawSample]:
    rig = FaultyRig(CountingRig(), faults)
    rig.open()
    return [rig.read() for _ in range(TICKS)]


EXPECTED = {
    "stuck_encoder": lambda s: s._replace(encoder_counts=good(FROM).encoder_counts),
    "encoder_jump": lambda s: s._replace(encoder_counts=s.encoder_counts - 250),
    "reversed_encoder": lambda s: s._replace(
        encoder_counts=good(FROM).encoder_counts - (s.encoder_counts - good(FROM).encoder_counts)
    ),
    "broken_wire": lambda s: s._replace(pressure_v=0.0),
    "stale_sample": lambda s: good(FROM),
}


@pytest.mark.parametrize("kind", EXPECTED)
def test_a_fault_of_a_sensor_spoils_its_ticks_only(kind):
    expected = [EXPECTED[kind](good(t)) if t in DUE else good(t) for t in range(TICKS)]
    assert samples(fault(kind, size=-250)) == expected


def test_a_pressure_of_nan_does_not_change_the_encoder():
    for tick, sample in enumerate(samples(fault("pressure_nan"))):
        assert math.isnan(sample.pressure_v) == (tick in DUE)
        assert sample._replace(pressure_v=0.0) == good(tick)._replace(pressure_v=0.0)


def test_a_fault_lasts_until_the_end_unless_it_has_a_duration():
    rig = FaultyRig(CountingRig(), [FaultSettings(kind="broken_wire", from_tick=2)])
    rig.open()
    assert [rig.read().pressure_v == 0.0 for _ in range(50)] == [False] * 2 + [True] * 48


def test_a_slow_read_passes_time_and_spoils_nothing():
    slept: list[float] = []
    rig = FaultyRig(CountingRig(), [fault("slow_read", size=0.25)], sleep=slept.append)
    rig.open()
    for tick in range(TICKS):
        before = len(slept)
        assert rig.read() == good(tick)
        assert slept[before:] == ([0.25] if tick in DUE else [])


def outcomes(kind: str) -> tuple[list[int], list[int], CountingRig]:
    """Return the ticks whose read failed, those whose write failed, and the inner rig."""
    inner = CountingRig()
    rig = FaultyRig(inner, [fault(kind)])
    rig.open()
    unread, unwritten = [], []
    for tick in range(TICKS):
        try:
            rig.read()
        except RigError:
            unread.append(tick)
        try:
            assert rig.write(float(tick)) == tick + 0.125
        except RigError:
            unwritten.append(tick)
    return unread, unwritten, inner


@pytest.mark.parametrize(
    ("kind", "reads_fail", "writes_fail"),
    [("read_error", True, False), ("write_error", False, True), ("device_lost", True, True)],
)
def test_a_fault_of_the_device_fails_its_own_calls_only(kind, reads_fail, writes_fail):
    unread, unwritten, inner = outcomes(kind)
    assert unread == (list(DUE) if reads_fail else [])
    assert unwritten == (list(DUE) if writes_fail else [])
    assert inner.written == [float(t) for t in range(TICKS) if t not in unwritten]


def test_an_injected_error_names_the_fault_its_tick_and_the_way_out():
    rig = FaultyRig(CountingRig(), [fault("device_lost", from_tick=0)])
    rig.open()
    with pytest.raises(RigError, match=r"device_lost.*tick 0.*remove the fault"):
        rig.read()


def test_a_lost_device_is_made_safe_and_closed_all_the_same():
    inner = CountingRig()
    rig = FaultyRig(inner, [fault("device_lost", from_tick=0)])
    rig.open()
    with pytest.raises(RigError):
        rig.read()
    rig.make_safe()
    rig.close()
    assert inner.calls == ["open", "make_safe", "close"]


def test_ticks_are_counted_from_zero_after_each_open():
    inner = CountingRig()
    rig = FaultyRig(inner, [fault("stuck_encoder", from_tick=1, ticks=2)])
    rig.open()
    assert [rig.read().encoder_counts for _ in range(4)] == [100, 107, 107, 121]
    rig.open()
    inner.reads = 9  # the muscle has moved on in the meantime
    assert [rig.read().encoder_counts for _ in range(4)] == [170, 177, 177, 191]


def test_two_faults_of_one_kind_each_begin_where_the_muscle_then_is():
    stuck = samples(
        fault("stuck_encoder", from_tick=1, ticks=2), fault("stuck_encoder", from_tick=6, ticks=2)
    )
    assert [s.encoder_counts for s in stuck[:9]] == [100, 107, 107, 121, 128, 135, 142, 142, 156]


def test_faults_of_different_kinds_add_up():
    spoiled = samples(fault("broken_wire"), fault("encoder_jump", size=1000))
    assert spoiled[FROM].pressure_v == 0.0
    assert spoiled[FROM].encoder_counts == good(FROM).encoder_counts + 1000


def test_a_faulty_rig_says_so_in_its_description():
    faults = [fault("broken_wire")]
    description = FaultyRig(CountingRig(), faults).describe()
    assert description.backend == "counting"
    assert description.extra["faults"] == [
        {"kind": "broken_wire", "from_tick": FROM, "ticks": LASTS, "size": 0.0}
    ]
