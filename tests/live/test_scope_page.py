"""The scope of `pamctl watch --web`, in a browser, against the log that the daemon writes."""

import json
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from support.chromium import Page
from support.processes.daemons import Daemon, parked
from support.processes.watch_pages import set_input, shown, tab, up

from pamctl.log.reader import Log, read

pytestmark = pytest.mark.long

assert all((up, shown, tab))  # fixtures


def show_values(tab: Page, expression: str) -> np.ndarray:
    return np.array(tab.value(f"Array.from({expression})"), dtype=float)


@pytest.fixture(scope="module")
def run(up: Daemon, tab: Page) -> Log:
    """One run that was watched: single trigger, a slider, a mark; its log, which is whole."""
    up.ask("goto", position_m=8e-3, within_s=0.5)
    tab.wait_for("scope.held && scope.held.last_tick > 500")
    for name, value in (("tfield", "reference_m"), ("tlevel", 8.75), ("thyst", 0.2)):
        set_input(tab, name, value)
    for name, value in (("tpre", 0.2), ("tpost", 0.4)):
        set_input(tab, name, value)
    tab.click("[data-mode=single]")
    up.wait_for("ready")
    up.ask("goto", position_m=9e-3, within_s=0.5)
    tab.wait_for("scope.mode === 'still' && scope.capture.trigger !== null")
    tab.value("window.captured = scope.capture, 0")
    up.wait_for("ready")
    # A slider, as a hand moves it: on the way, then let go.
    tab.value(
        "(() => { const s = document.querySelector('[data-gain=lambda_per_s] input[type=range]');"
        " s.value = 600; s.dispatchEvent(new Event('input'));"
        " s.dispatchEvent(new Event('change')); })()"
    )
    tab.wait_for("!byId('undo').disabled")
    tab.value("window.chosen = bench.gains.find(g => g.name === 'lambda_per_s').value")
    tab.click("#undo")
    tab.wait_for("byId('undo').disabled")
    set_input(tab, "marktext", "a spike")
    tab.value("byId('markform').requestSubmit()")
    up.wait_until(lambda s: any(e.get("text") == "a spike" for e in s["events"]))
    name = Path(up.ask("status")["log"])
    up.ask("stop")
    parked(up)
    return read(name)


def test_the_trigger_fires_at_the_tick_of_the_crossing_and_every_tick_is_there(run, tab):
    reference = run["reference_m"]
    goes_up = np.flatnonzero((reference[1:] >= 8.75e-3) & (reference[:-1] < 8.75e-3)) + 1
    assert tab.value("captured.trigger") == run["tick"][goes_up[0]]
    ticks = show_values(tab, "captured.ticks")
    assert ticks[0] <= tab.value("captured.trigger") - 150
    rows = np.isin(run["tick"], ticks)
    at = np.flatnonzero(rows)
    assert len(at) == len(ticks) == at[-1] - at[0] + 1, "no tick of the log is missing"
    for name in ("position_m", "reference_m", "error_m", "valve_v", "t_s"):
        assert np.array_equal(show_values(tab, f"captured.raw.{name}"), run[name][rows])


def test_cursors_stand_on_samples_and_the_table_is_of_the_samples_between(run, tab):
    tab.value("(setMode('still'), scope.view = null, showCapture(captured))")
    t = show_values(tab, "captured.t")
    a, b = 40, len(t) - 60
    set_input(tab, "cura", t[a] + 1e-5)
    set_input(tab, "curb", t[b] - 1e-5)
    assert tab.value("scope.cursors") == [a, b]
    told = tab.value(
        "[...document.querySelectorAll('#measures [data-field=position_m] td')]"
        ".map(c => Number(c.textContent.replace('\\u2212', '-')))"
    )
    rows = np.isin(run["tick"], show_values(tab, "captured.ticks"))
    mm = run["position_m"][rows] * 1e3
    span = mm[a : b + 1]
    expected = [mm[a], mm[b], mm[b] - mm[a], span.min(), span.max(), np.ptp(span), span.mean(),
                np.sqrt(np.mean(span**2))]  # fmt: skip
    assert told == pytest.approx(expected, rel=2e-5, abs=1e-5)


def test_a_slider_is_a_gains_event_of_the_log_with_its_ramp_and_undo_another(run, tab):
    values = [gains["lambda_per_s"] for gains in run.gains]
    changed = [after for before, after in pairwise(values) if after != before]
    assert changed == [pytest.approx(tab.value("chosen")), values[0]]
    assert run.gains[1]["ramp_s"] == 0.5
    marks = [event["text"] for event in run.events if event.get("event") == "mark"]
    assert any("lambda_per_s" in text and text.startswith("page:") for text in marks)
    assert marks[-1] == "a spike"


def test_a_view_that_left_ticks_out_has_all_of_them_when_it_stands_still(run, tab):
    last = int(run["tick"][-1])
    whole = f"{{ log: captured.log, first: {last - 400}, last: {last}, trigger: null }}"
    tab.value(f"(setMode('roll'), loadCapture({whole}, 7).then(setStill))")
    tab.wait_for("scope.capture.every === 1")
    wanted = run["tick"][run["tick"] >= last - 400]
    assert show_values(tab, "scope.capture.ticks")[-1] > wanted[-1] - 7
    assert np.array_equal(
        show_values(tab, "scope.capture.ticks"), wanted[: tab.value("scope.capture.ticks.length")]
    )


def test_a_drag_zooms_and_pauses_and_a_layout_is_kept(run, tab):
    tab.value("(showCapture(captured), setView(-0.05, 0.1))")
    assert tab.value("scope.mode") == "still"
    low, high = tab.value(
        "[scope.charts[0].chart.scales.x.min, scope.charts[0].chart.scales.x.max]"
    )
    assert (low, high) == (pytest.approx(-0.05), pytest.approx(0.1))
    tab.value("changePanes(panes => panes.push(['pressure_pa']))")
    tab.wait_for("scope.panes.length === 4 && scope.capture.raw.pressure_pa")
    set_input(tab, "layoutname", "mine")
    tab.click("#savelayout")
    tab.value("changePanes(panes => panes.pop())")
    tab.wait_for("scope.panes.length === 3")
    set_input(tab, "layout", "mine")
    tab.wait_for("scope.panes.length === 4 && scope.charts.length === 4")
    pressure = show_values(tab, "scope.capture.raw.pressure_pa")
    rows = np.isin(run["tick"], show_values(tab, "scope.capture.ticks"))
    assert np.array_equal(pressure, run["pressure_pa"][rows])


def test_a_saved_capture_opens_again_and_its_cut_is_a_log(run, tab, shown, tmp_path):
    tab.value("showCapture(captured)")
    before = show_values(tab, "captured.raw.position_m")
    again = show_values(tab, "csvToCapture(captureAsCsv(), 'x.csv').raw.position_m")
    assert np.array_equal(before, again), "to the bit"
    assert tab.value("captureAsPng().then(b => b.type)") == "image/png"
    tab.click("#keep")
    tab.value("openLog(captured.log)")
    assert tab.value("scope.capture.ticks.length") == len(run)
    tab.wait_for("byId('marks').textContent.includes('a spike')")
    tab.click("#marks button:last-child")
    mark = next(event for event in run.events if event.get("text") == "a spike")
    middle_s = float(run["t_s"][run["tick"] == mark["tick"]][0])
    low_s, high_s = tab.value("scope.view")
    assert low_s < middle_s <= high_s, "a click on a mark shows what is around it"
    tab.value("openKept(0)")
    assert np.array_equal(show_values(tab, "scope.capture.raw.position_m"), before)
    assert tab.value("scope.capture.trigger") == tab.value("captured.trigger")
    ticks = show_values(tab, "captured.ticks")
    query = f"log={run.path.name}&first={int(ticks[0])}&last={int(ticks[-1])}"
    status, body, _ = shown.ask("GET", f"/scope/cut?{query}")
    assert status == 200
    piece = tmp_path / "piece.mcap"
    piece.write_bytes(body)
    assert np.array_equal(read(piece)["position_m"], before)


def test_a_minute_at_10_khz_is_drawn_by_its_extremes_and_kept_whole(tab):
    count, spike, dip = 600_000, 123_457, 400_001
    tab.value(
        f"(() => {{ const n = {count}, t = Float64Array.from({{ length: n }}, (_, k) => k * 1e-4);"
        " const wave = t.map(s => Math.sin(s)), tick = t.map((_, k) => k);"
        f" wave[{spike}] = 9; wave[{dip}] = -9; wave[7] = NaN;"
        " setMode('still'); scope.rateHz = 10000; scope.view = null;"
        " window.panesBefore = scope.panes; scope.panes = [['error_m']]; buildPanes();"
        " showCapture({ log: '', first: 0, last: n - 1, trigger: null, every: 1, events: [],"
        " raw: { tick, t_s: t, error_m: wave }, t0: 0, ticks: tick, t }); })()"
    )
    drawn = "scope.charts[0].chart.data"
    assert tab.value(f"{drawn}[0].length") < 10_000
    low, high = tab.value(f"[Math.min(...{drawn}[1]), Math.max(...{drawn}[1])]")
    assert (low, high) == pytest.approx((-9e6, 9e6)), "micrometres"
    assert (
        tab.value(f"findGaps(scope.charts[0].chart, 1, 0, {drawn}[0].length - 1, []).length") == 0
    )
    tab.value(f"setView({spike * 1e-4 - 0.01}, {spike * 1e-4 + 0.01})")
    assert tab.value(f"{drawn}[0].includes(scope.capture.t[{spike}])"), "every tick is there"
    assert tab.value("scope.capture.raw.error_m.length") == count
    tab.value(
        "(scope.rateHz = bench.rate_hz ?? 1000, scope.view = null, scope.panes = panesBefore, 0)"
    )


def test_the_spectrum_is_that_of_numpy(tab):
    rate_hz, count = 1000.0, 1500
    t = np.arange(count) / rate_hz
    x = 3.0 + 0.7 * np.sin(2 * np.pi * 50.0 * t) + 0.2 * np.cos(2 * np.pi * 120.3 * t)
    told = tab.value(
        f"(r => [Array.from(r.hz), Array.from(r.amplitude)])(spectrum(Float64Array.from("
        f"{json.dumps(x.tolist())}), {rate_hz}))"
    )
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(count) / count)
    lines = np.abs(np.fft.rfft((x - x.mean()) * window, 2048))[:-1] * 2 / window.sum()
    assert told[0] == pytest.approx(np.fft.rfftfreq(2048, 1 / rate_hz)[:-1])
    assert told[1] == pytest.approx(lines, abs=1e-12)


def test_nothing_complains_on_a_phone_and_escape_is_the_emergency_stop(up, shown, tab, tmp_path):
    tab.screenshot(tmp_path / "scope.png")
    tab.open(shown.address, width=390, height=844)
    tab.wait_for("scope.charts.length > 0")
    assert tab.value("document.documentElement.scrollWidth") <= 390
    tab.screenshot(tmp_path / "phone.png")
    up.ask("goto", position_m=8e-3, within_s=0.5)
    up.wait_for("ready")
    tab.value(
        "document.querySelector('#operator').dispatchEvent("
        "new KeyboardEvent('keydown', { key: 'Escape', bubbles: true }))"
    )
    up.wait_safe()
    tab.wait_for("document.querySelector('#state').textContent === 'fault'")
    up.wait_until(lambda s: not s["pids"])
    tab.click("#ack")
    up.wait_for("idle")
    assert tab.complaints == []
