"""What `pamctl diagnose --without` takes: the words of a verdict."""

from __future__ import annotations

import pytest
from support.command_line import run_pamctl

from pamctl.cli.diagnose import _find_left_out
from pamctl.plant.model import PlantSettings


@pytest.mark.parametrize(
    ("word", "left_out"),
    [
        ("coulomb_friction", ["coulomb_friction"]),
        ("curve of braid_friction over velocity", ["braid_friction~curve(velocity)"]),
        ("braid_friction~curve(velocity)", ["braid_friction~curve(velocity)"]),
        ("skew of position_m", ["position_late"]),
        ("position_late", ["position_late"]),
    ],
)
def test_a_word_of_a_verdict_can_be_left_out(word: str, left_out: list[str]) -> None:
    assert _find_left_out(word, PlantSettings()) == left_out


def test_the_place_of_laws_without_a_name_leaves_all_of_them_out() -> None:
    left_out = _find_left_out("braid_friction", PlantSettings())
    assert {"braid_friction~curve(velocity)", "braid_friction~onset(time)"} <= {*left_out}
    assert all(name.startswith("braid_friction~") for name in left_out)


def test_an_unknown_word_is_told_what_can_be_left_out() -> None:
    done = run_pamctl("diagnose", "x.mcap", "--without", "braid_frictoin", "--out", "never")
    assert done.returncode == 2
    said = " ".join(done.stderr.replace("\u2502", " ").split())
    assert "there is no effect or law braid_frictoin; did you mean braid_friction?" in said
    assert "all laws without a name of a place such as force" in said
