"""The page at work: triggers that repeat, runs laid over each other, drags, keys, names."""

import json
import os
from collections.abc import Iterator
from importlib.resources import files
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from support.chromium import Page
from support.processes.daemons import TRACKING, Daemon, as_root, nobody, parked, run_to_its_end
from support.processes.watch_pages import set_input, shown, tab, up

from pamctl.daemon.client import DaemonDeclinedError
from pamctl.live.tick_memory import TickMemory
from pamctl.log.reader import Log, read
from pamctl.recording.ring import Ring, RingError
from pamctl.signals import Phase

pytestmark = pytest.mark.long

assert all((up, shown, tab))  # fixtures

OFFSET_MM, AFTER_S, HOLDOFF_S = 8.0, 0.06, 0.4
WAVE: dict[str, Any] = {
    **TRACKING, "offset_mm": OFFSET_MM, "amplitude_mm": 1.0, "transition_s": 0.125, "cycles": 200,
}  # fmt: skip
"""Four times a second, at once: a sine would begin seven seconds later."""


def find_rises(log: Log) -> list[int]:
    x, middle_m = log["reference_m"], OFFSET_MM * 1e-3
    rises = np.flatnonzero((x[1:] >= middle_m) & (x[:-1] < middle_m)) + 1
    return [int(tick) for tick in log["tick"][rises]]


@pytest.fixture(scope="module")
def watched(up: Daemon, tab: Page) -> tuple[Log, dict[str, list[int]]]:
    """A wave that was watched in one mode after the other, and the triggers of each mode."""
    tab.value("document.querySelector('#panes').scrollIntoView({ behavior: 'instant' })")
    tab.value(
        "(window.seen = {}, window.show = showCapture, showCapture = capture => {"
        " (seen[window.stage] ??= []).push(capture.trigger); show(capture); }, 0)"
    )
    wanted = {"tfield": "reference_m", "tlevel": OFFSET_MM, "thyst": 0.1, "tpre": 0.05,
              "tpost": AFTER_S}  # fmt: skip
    for name, value in wanted.items():
        set_input(tab, name, value)
    log = Path(up.ask("start", experiment=WAVE, name="wave")["log"]).name
    tab.wait_for(f"scope.held?.log === {json.dumps(log)}")
    tab.value("window.stage = 'normal', 0")
    tab.click("[data-mode=normal]")
    tab.wait_for("seen.normal?.length >= 3")
    tab.value("window.stage = 'held off', 0")
    set_input(tab, "tholdoff", HOLDOFF_S)
    tab.wait_for("seen['held off']?.length >= 2")
    tab.value("window.stage = 'between', 0")
    set_input(tab, "tholdoff", 0)
    set_input(tab, "tlevel", 20)
    tab.value("window.stage = 'auto', 0")
    tab.click("[data-mode=auto]")
    tab.wait_for("seen.auto?.length >= 2")
    tab.value("window.stage = 'auto again', 0")
    set_input(tab, "tlevel", OFFSET_MM)
    tab.wait_for("seen['auto again']?.some(tick => tick !== null)")
    seen = tab.value("seen")
    tab.value("(showCapture = window.show, 0)")
    up.ask("stop")
    parked(up)
    return read(up.logs / log), seen


def test_normal_fires_again_and_again_at_the_ticks_of_the_crossings(watched):
    log, seen = watched
    rises = find_rises(log)
    assert set(seen["normal"]) <= set(rises)
    gaps = [following(rises, a + round(AFTER_S * 1000)) == b for a, b in pairwise(seen["normal"])]
    assert len(gaps) >= 2
    assert all(gaps), "no crossing after the capture was left out"


def test_holdoff_keeps_the_next_trigger_away_and_not_the_one_behind_it(watched):
    log, seen = watched
    rises, held = find_rises(log), seen["held off"]
    for a, b in pairwise(held):
        assert b - a > HOLDOFF_S * 1000
        assert b == following(rises, a + round(HOLDOFF_S * 1000))


def following(rises: list[int], tick: int) -> int:
    return next(rise for rise in rises if rise > tick)


def test_auto_rolls_while_no_trigger_comes_and_fires_when_one_does(watched):
    log, seen = watched
    assert set(seen["auto"]) == {None}
    fired = {tick for tick in seen["auto again"] if tick is not None}
    assert fired <= set(find_rises(log))


@pytest.mark.parametrize("how", ["phase", "trigger"])
def test_runs_lie_over_each_other_with_their_zero_where_it_was_asked(up, watched, tab, how):
    if len(up.finished_logs()) < 2:
        run_to_its_end(up, {**WAVE, "cycles": 2}, "later")
    tab.value("loadRuns()")
    tab.wait_for("document.querySelectorAll('[data-run]').length === 2")
    tab.value("document.querySelectorAll('[data-run]').forEach(box => { box.checked = true; })")
    set_input(tab, "align", how)
    tab.value("overlayRuns()")
    drawn = tab.value(
        "(d => d.slice(1).map(c => c[d[0].indexOf(0)]))(overlayCharts[0].data.map(c => [...c]))"
    )
    names = tab.value("overlayCharts[0].series.slice(1).map(s => s.label)")
    assert len(names) == tab.value("overlayCharts.length") == 2
    counts = tab.value("overlayCharts[0].data.slice(1).map(c => c.filter(v => v != null).length)")
    assert counts == [len(read(up.logs / name)) for name in names]
    for name, value_mm in zip(names, drawn, strict=True):
        log = read(up.logs / name)
        tracks = log["tick"][log["phase"] == Phase.TRACK]
        tick = int(tracks[0]) if how == "phase" else find_rises(log)[0]
        assert value_mm == pytest.approx(log["position_m"][log["tick"] == tick][0] * 1e3)


# --- orders ------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def holding(up: Daemon, watched: object, tab: Page) -> Iterator[Path]:
    """The muscle holds 8 mm; the log that it is in."""
    log = Path(up.ask("goto", position_m=8e-3, within_s=0.5)["log"])
    tab.wait_for("byId('state').textContent === 'ready' && series.reference.at(-1) === 8")
    tab.value("window.scrollTo(0, 0)")
    yield log
    up.ask("stop")
    parked(up)


def reference_mm(up: Daemon) -> float:
    return round(up.ask("status")["tick"]["reference_m"] * 1e3, 6)


def test_a_position_is_dragged_in_the_plot_and_a_drag_to_the_side_is_none(up, holding, tab):
    tab.value("(byId('target').value = 8, 0)")
    tab.drag("#gotohandle span", 900, 30)
    assert float(tab.value("byId('target').value")) < 8, "it was dragged down, and out"
    assert tab.value("[dragged.mm, heldScale]") == [None, None]
    assert reference_mm(up) == 8.0
    tab.drag("#gotohandle span", 0, -12)
    wanted = float(tab.value("byId('target').value"))
    assert 8.0 < wanted < 20.0
    up.wait_until(lambda _: reference_mm(up) == wanted)
    low, high = tab.value("bench.stroke_mm")
    assert low < wanted < high
    up.wait_for("ready")


def test_the_arrow_keys_and_enter_go_to_a_position(up, holding, tab):
    up.wait_for("ready")
    before = reference_mm(up)
    tab.wait_for(f"Math.abs(series.reference.at(-1) - {before}) < 1e-6")
    tab.value("document.querySelector('#gotohandle').focus()")
    tab.press("ArrowUp", "ArrowUp", "ArrowUp")
    told = tab.value("document.querySelector('#gotohandle').getAttribute('aria-valuetext')")
    assert told == f"{before + 0.3:.2f} mm"
    assert reference_mm(up) == before, "nothing moves before Enter"
    tab.press("Enter")
    up.wait_until(lambda _: reference_mm(up) == pytest.approx(before + 0.3))
    up.wait_for("ready")


def test_page_and_log_say_who_changed_which_gain_and_anyone_can_undo_it(up, holding, tab):
    was = up.ask("status")["controller"]["lambda_per_s"]
    set_input(tab, "operator", "Ann")
    set_input(tab, "gain-lambda_per_s", 60)
    tab.wait_for("byId('gainchanges').textContent.includes('Ann: lambda_per_s')")
    up.ask("set", changes=["controller.lambda_per_s=70"], operator="B\u202eo")
    tab.wait_for("byId('undo').textContent === 'Undo: lambda_per_s 60 to 70'")
    tab.click("#undo")
    up.wait_until(lambda s: s["controller"]["lambda_per_s"] == 60)
    tab.wait_for("byId('undo').textContent.includes('to 60')")
    tab.click("#undo")
    up.wait_until(lambda s: s["controller"]["lambda_per_s"] == was)
    tab.wait_for("byId('undo').disabled")
    with pytest.raises(DaemonDeclinedError, match="left to undo"):
        up.ask("undo")
    texts = [f"Ann: lambda_per_s {was:.6g} to 60", "Bo: lambda_per_s 60 to 70",
             "Ann: lambda_per_s 70 to 60 (undo)"]  # fmt: skip
    changes = up.ask("status")["gain_changes"]
    assert [f"{c['by']}: {c['what']}" for c in changes[:3]] == texts
    up.ask("stop")
    parked(up)
    marks = [e["text"] for e in read(holding).events if e.get("event") == "mark"]
    assert marks[:3] == texts
    up.ask("goto", position_m=8e-3, within_s=0.5)
    up.wait_for("ready")


def test_a_gain_that_the_keyboard_changed_keeps_the_keyboard(up, holding, tab):
    slider = "document.querySelector('[data-gain=eta] input[type=range]')"
    values = [up.ask("status")["controller"]["eta"]]
    tab.value(f"{slider}.focus()")
    for _ in range(2):
        tab.press("ArrowUp")
        up.wait_until(lambda s: s["controller"]["eta"] > values[-1])
        values.append(up.ask("status")["controller"]["eta"])
        tab.wait_for(f"document.activeElement === {slider}")
    for _ in range(2):
        up.ask("undo")
    assert up.ask("status")["controller"]["eta"] == values[0]


@as_root
def test_the_group_that_may_steer_can_read_every_tick_and_write_none(up, holding):
    ring = Path(up.ask("status")["ring"])
    assert (ring.stat().st_mode & 0o777, ring.stat().st_gid) == (0o640, os.getegid())
    memory = TickMemory()
    with nobody():  # another user, still of this group
        memory.follow(str(ring), str(holding))
        with pytest.raises(RingError, match="Permission"):
            Ring.attach(ring)
    assert memory.state().last_tick > memory.state().first_tick
    memory.close()


# --- for everyone ------------------------------------------------------------------------------


def test_the_page_breaks_no_rule_for_accessible_pages_and_the_stop_is_the_first_key(
    shown, holding, tab
):
    rules = (files("axe_core_python") / "axe.min.js").read_text()
    for width, colours in ((1280, "light"), (390, "dark")):
        tab.choose_colours(colours)
        tab.open("about:blank", width=width, height=844)
        tab.open(shown.address, width=width, height=844)
        tab.wait_for("bench.gains.length && !byId('gotohandle').hidden")
        tab.value(f"{rules};0")
        broken = tab.value("axe.run().then(r => r.violations.map(v => [v.id, v.nodes[0].html]))")
        assert broken == []
    tab.press("Tab")
    assert tab.value("document.activeElement.id") == "estop"
    for name in ("state", "estop", "error"):
        bottom = tab.value(f"byId('{name}').getBoundingClientRect().bottom")
        assert 0 < bottom < 844 / 3, "a phone shows it first"
    assert tab.complaints == []
