"""A dirty rig is what its truth says: each small thing, its share, its place; and the rungs."""

import pytest

from hidden.dirty import DIRT
from hidden.rungs import KINDS, NAMES, PLACES, Cause, Said, carried_rung, mark, named_cause
from pamctl.plant.catalogue import CATALOGUE


def test_every_kind_of_dirt_has_a_place() -> None:
    for kind in DIRT.values():
        assert all(place in PLACES and law in (*KINDS, "") for place, law in kind.where)
        assert set(kind.names) <= {
            *NAMES, "skew.pressure_pa", "skew.position_m", "crosstalk.pressure_pa",
        }  # fmt: skip


# --- the rungs --------------------------------------------------------------------------------


def test_every_effect_of_the_catalogue_has_a_place() -> None:
    assert set(NAMES) == set(CATALOGUE)


LEAK = named_cause("chamber_leak")
BOW = Cause("bow", frozenset({("pressure_sensor", "curve")}), "none")


@pytest.mark.parametrize(
    ("said", "verdict"),
    [
        (Said(frozenset({"chamber_leak"})), "right at name"),
        (Said(frozenset({"chamber_leak", "stribeck"})), "wrong name"),
        (Said(sets=(frozenset({"chamber_leak", "dead_volume"}),)), "low"),
        (Said(admits=True), "admitted"),
        (Said(places=frozenset({("chamber", "curve")})), "low"),
        (Said(places=frozenset({("encoder", "memory")})), "wrong place"),
        (Said(frozenset({"chamber_leak", "bow.pressure_pa"})), "right at name"),
        (Said(frozenset({"chamber_leak", "bow.position_m"})), "wrong name"),
        (Said(), "missed"),
        (Said(places=frozenset({("pressure_sensor", "curve")})), "missed"),
        (Said(refusal="too short"), "refused"),
    ],
)
def test_what_is_said_is_marked_at_the_rung_it_reaches(said: Said, verdict: str) -> None:
    assert mark([LEAK, BOW], said)[0] == verdict


def test_a_set_reaches_what_its_members_have_in_common() -> None:
    sensor = named_cause("pressure_sensor_gain", "set")
    lag = named_cause("command_delay", "name", "skew.valve_v")
    across = Said(sets=(frozenset({"pressure_sensor_gain", "valve_asymmetry"}),))
    same = Said(sets=(frozenset({"command_delay", "skew.valve_v"}),))
    late = Said(sets=(frozenset({"command_delay", "valve_spool"}),))
    assert mark([sensor], across)[0] == "right at set"
    assert mark([lag], same)[0] == "right at name"
    assert mark([named_cause("command_delay", "kind")], late)[0] == "right at kind"


def test_a_rung_falls_with_what_is_beside_the_effect() -> None:
    assert carried_rung("creep", 3, "short") == "name"
    assert carried_rung("command_delay", 1, "short") == "kind", "a spool imitates it"
    assert carried_rung("dead_volume", 1, "short") == "none", "nobody can see it"
    assert carried_rung("encoder_scale", 3, "short") == "name"
    assert carried_rung("encoder_scale", 3, "short", beside=0.4) == "set"
