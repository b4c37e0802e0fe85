"""The words of `pamctl diagnose`: what `--without` takes, and an audit that fits a terminal."""

from itertools import combinations

import pytest
from support.command_line import run_pamctl

from pamctl.cli.diagnose import _find_left_out, report_audit
from pamctl.diagnose.audit import Audit, BlindSpot, Inseparable
from pamctl.plant.catalogue import CATALOGUE
from pamctl.plant.model import PlantSettings
from pamctl.report.report import format_terminal

# --- --without -----------------------------------------------------------------------------------


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
def test_a_word_of_a_verdict_can_be_left_out(word, left_out):
    assert _find_left_out(word, PlantSettings()) == left_out


def test_the_place_of_laws_without_a_name_leaves_all_of_them_out():
    left_out = _find_left_out("braid_friction", PlantSettings())
    assert {"braid_friction~curve(velocity)", "braid_friction~onset(time)"} <= {*left_out}
    assert all(name.startswith("braid_friction~") for name in left_out)


def test_an_unknown_word_is_told_what_can_be_left_out():
    done = run_pamctl("diagnose", "x.mcap", "--without", "braid_frictoin", "--out", "never")
    assert done.returncode == 2
    said = " ".join(done.stderr.replace("\u2502", " ").split())
    assert "there is no effect or law braid_frictoin; did you mean braid_friction?" in said
    assert "all laws without a name of a place such as force" in said


# --- --audit -------------------------------------------------------------------------------------

NAMES = sorted(CATALOGUE)[:20]
SPOTS = tuple(
    BlindSpot(name, "the command leaves the null at once, " * 4, "slow-ramps", (0.3, "V"))
    for name in NAMES
)


@pytest.mark.parametrize("verbose", [False, True])
def test_an_audit_fits_into_100_columns(verbose):
    pairs = tuple(
        Inseparable(pair, ("chirp", "")[number % 2], "w")
        for number, pair in enumerate(combinations(NAMES, 2))
    )
    unasked = tuple((name, "no candidate of the search, " * 5) for name in NAMES)
    found = Audit(tuple(NAMES), SPOTS, pairs, unasked)
    report = report_audit(found, lambda name: f"pamctl run --experiment {name}", verbose=verbose)
    lines = format_terminal(report).splitlines()
    assert max(map(len, lines)) <= 100
    assert ("leaves the null" in "\n".join(lines)) == verbose
    assert ("no candidate of the search" in "\n".join(lines)) == verbose
    assert "does not ask" in "\n".join(lines)
    assert "pamctl run --experiment slow-ramps" in " ".join(map(str.strip, lines))


def test_an_audit_names_the_experiment_that_tells_a_pair_apart():
    pairs = (
        Inseparable(("creep", "drift"), "chirp", ""),
        Inseparable(("creep", "valve_leak"), "", ""),
        Inseparable(("drift", "valve_leak"), "square-1", ""),
    )
    report = report_audit(Audit((), (), pairs), str.upper, verbose=False)
    lines = format_terminal(report).splitlines()
    assert "- creep and drift, creep and valve_leak, drift and valve_leak" in lines
    assert "- add: CHIRP  # for creep and drift" in lines
    assert "- add: SQUARE-1  # for drift and valve_leak" in lines


def test_an_audit_sends_a_record_that_the_plant_does_not_explain_to_a_diagnosis_first():
    found = Audit((), SPOTS[:1], (), is_covered=True).advise_nothing()
    said = format_terminal(report_audit(found, str.upper, verbose=False))
    assert "- first let pamctl diagnose find what is missing" in said
    assert "experiments that do" not in said


def test_an_audit_advises_what_two_experiments_have_in_common_once():
    spots = [BlindSpot("drift", "", "squares-apart", None), BlindSpot("creep", "", "chirp", None)]
    report = report_audit(Audit((), tuple(spots), ()), lambda _: "record: steps", verbose=False)
    assert "- add: record: steps  # for drift, creep" in format_terminal(report)
