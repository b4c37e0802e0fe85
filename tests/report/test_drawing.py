"""Plots draw all extremes, at the right positions."""

import re
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from pamctl.report.axes import (
    PlotAxis,
    Scale,
    break_at_gaps,
    choose_step,
    find_unbroken,
    keep_extremes,
    thin_cloud,
)
from pamctl.report.figure import Plot, plot_apart
from pamctl.report.html_page import write_html
from pamctl.report.picture import draw_plot
from pamctl.report.report import Facts, Figure, Fold, Points, Report, ReportTable, Section, Text

HEIGHTS = st.floats(-1e6, 1e6, allow_nan=False)
HOSTILE = '</title><script>alert("1")</script><img src=x onerror=alert(1)>&"\''
T, Y = PlotAxis("time", "s", tight=True), PlotAxis("displacement", "mm")


@st.composite
def lines(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray]:
    count = draw(st.integers(1, 400))
    steps = draw(arrays(np.float64, count, elements=st.floats(0.0, 3.0)))
    return np.cumsum(steps), draw(arrays(np.float64, count, elements=HEIGHTS))


@given(lines(), st.floats(0.5, 50.0))
def test_every_column_keeps_its_lowest_and_its_highest_point(line, column):
    x, y = line
    kept = keep_extremes(x, y, column)
    assert (np.diff(kept) > 0).all()
    assert {0, len(x) - 1} <= set(kept.tolist())
    columns = np.floor(x / column)
    assert len(kept) <= 2 * len(np.unique(columns)) + 2
    for place in np.unique(columns):
        inside, drawn = y[columns == place], y[kept][columns[kept] == place]
        assert (drawn.min(), drawn.max()) == (inside.min(), inside.max())


@given(lines(), st.floats(0.5, 50.0))
def test_every_point_of_a_cloud_lies_in_a_cell_that_is_drawn(line, cell):
    x, y = line

    def cells(kept):
        return set(zip(np.floor(x[kept] / cell), np.floor(y[kept] / cell), strict=True))

    kept = thin_cloud(x, y, cell)
    assert cells(kept) == cells(np.arange(len(x)))
    assert y[kept].min() == y.min()
    assert x[kept].max() == x.max()


def test_a_single_spike_of_a_minute_at_1_khz_reaches_the_drawing():
    t = np.arange(60_000) * 1e-3
    y = np.zeros_like(t)
    y[31_415] = 1.0
    drawn = draw_plot(Plot("spike", T, PlotAxis("y", low=0.0, high=1.0), height_px=100).line(t, y))
    (outline,) = re.findall(r'<path class="l c0" d="([^"]+)"', drawn)
    assert min(_heights(outline)) == 0  # the top of the frame
    assert len(outline) < 20_000


def test_a_line_breaks_where_the_value_is_not_a_number_and_a_lone_point_is_a_dot():
    y = np.array([1.0, 2.0, np.nan, 3.0, np.inf, 4.0, 5.0])
    assert find_unbroken(np.arange(7.0), y) == [slice(0, 2), slice(3, 4), slice(5, 7)]
    drawn = draw_plot(Plot("gaps", T, Y).line(np.arange(7.0), y))
    (outline,) = re.findall(r'<path class="l c0" d="([^"]+)"', drawn)
    assert outline.count("M") == 3
    assert "h0" in outline


def test_a_step_line_holds_its_value_until_the_next():
    drawn = Plot("steps", T, PlotAxis("u", "V", low=0.0, high=1.0), height_px=100)
    outline = draw_plot(drawn.line([0.0, 1.0, 2.0], [0.0, 1.0, 0.5], step=True))
    (path,) = re.findall(r'<path class="l c0" d="([^"]+)"', outline)
    assert path == "M0 1000l3600 0 0-1000 3600 0 0 500"


@given(st.floats(-1e9, 1e9), st.floats(1e-9, 1e9), st.integers(3, 10))
def test_ticks_are_round_and_rising_and_distinct_and_within_the_axis(low, span, about):
    scale = Scale(low, low + span)
    if not scale.high - scale.low > 1e-9 * max(abs(low), 1.0):
        return
    ticks = scale.ticks(about)
    assert len(ticks) <= max(about + 1, 5)
    assert len({tick.text for tick in ticks}) == len(ticks)
    assert all(-1e-6 <= tick.place <= 1 + 1e-6 for tick in ticks)
    assert sorted(ticks) == ticks


@given(st.floats(1e-12, 1e12))
def test_a_nice_step_is_one_two_or_five_times_a_power_of_ten(rough):
    step = choose_step(rough)
    digits = f"{step:.3e}"
    assert digits[:5] in ("1.000", "2.000", "5.000")
    assert rough * 0.99 <= step <= rough * 2.6


def test_hostile_texts_are_escaped_everywhere():
    page = Report(HOSTILE, HOSTILE, subtitle=HOSTILE)
    page.add(Section(HOSTILE))
    page.add(Section(HOSTILE, is_part=True))
    page.add(Text(HOSTILE))
    page.add(Points([HOSTILE]))
    page.add(Text(HOSTILE, "note"))
    page.add(Facts({HOSTILE: HOSTILE}))
    page.add(ReportTable([HOSTILE], [[HOSTILE]], HOSTILE))
    page.add(Fold(HOSTILE, HOSTILE))
    plot = Plot(HOSTILE, PlotAxis(HOSTILE, HOSTILE), PlotAxis(HOSTILE, HOSTILE))
    plot.line([0.0, 1.0], [0.0, 1.0], HOSTILE).level(0.5, HOSTILE).place(0.5, HOSTILE)
    page.add(Figure([plot], HOSTILE))
    html = write_html(page)
    assert "<script" not in html
    assert "<img" not in html
    assert "&lt;script&gt;" in html


def test_a_page_asks_for_nothing_outside_itself():
    page = Report("alone")
    page.add(Figure([Plot("p", T, Y).line([0.0, 1.0], [0.0, 1.0])]))
    html = write_html(page)
    assert not re.search(r"(?:src|href)\s*=\s*[\"'](?!#)", html)
    assert not re.search(r"url\(|@import|https?:", html)
    assert "default-src &#x27;none&#x27;" in html or "default-src 'none'" in html


def test_every_kind_of_mark_makes_well_formed_svg():
    x = np.linspace(0.0, 1.0, 50)
    plot = Plot("all", PlotAxis("x"), PlotAxis("y"))
    plot.line(x, x, "a").points(x, x**3, "c").band(x, 0.0, x, "d", solid=True)
    plot.level(0.2, "l").place(0.3, "p")
    root = ElementTree.fromstring(draw_plot(plot))
    drawn = root.findall(".//svg[@class='data']/path")
    assert len(drawn) == 5
    assert all(path.get("d") for path in drawn)


def test_a_plot_without_data_says_so():
    for data in ([], [np.nan, np.nan]):
        assert "nothing was measured" in draw_plot(Plot("p", T, Y).line(data, data))
    assert "nothing was measured" not in draw_plot(Plot("p", T, Y).line([0.0], [1.0]))


def test_data_of_unequal_length_are_refused_by_the_plots_name():
    with pytest.raises(ValueError, match="spiral: x has shape"):
        Plot("spiral", T, Y).line([0.0, 1.0], [0.0])


def _heights(outline: str) -> list[int]:
    """The vertical places of a path of one move and relative steps."""
    numbers = [int(n) for n in re.findall(r"-?\d+", outline)]
    return np.cumsum(numbers[1::2]).tolist()


def test_a_line_over_time_breaks_where_nothing_was_measured():
    t_s = np.r_[np.arange(20) * 1e-3, 0.5 + np.arange(20) * 1e-3]
    over, up = break_at_gaps(t_s, np.ones(40))
    assert np.flatnonzero(np.isnan(up)).tolist() == [20]
    assert t_s[19] < over[20] < t_s[20]
    assert np.array_equal(over[np.isfinite(up)], t_s)
    plot = Plot("a", PlotAxis("time", "s"), PlotAxis("b"))
    drawn = draw_plot(plot.line(t_s, np.ones(40)))
    assert drawn.count("M", drawn.index('class="data"')) >= 2
    few = np.array([0.0, 1.0, 100.0])
    assert break_at_gaps(few, few)[0] is few


def test_lines_that_hide_each_other_get_plots_of_their_own_with_one_y_axis():
    t_s = np.linspace(0.0, 10.0, 5000)
    noise = np.random.default_rng(2).normal(size=(2, 5000))
    signals = {"a": noise[0], "b": 2.0 * noise[1], "c": t_s + 20.0}

    def draw(names: list[str]) -> Plot:
        plot = Plot(" ".join(names), T, Y)
        for name in names:
            plot.line(t_s, signals[name], name)
        return plot

    apart = plot_apart(draw, ["a", "b"])
    assert [plot.title for plot in apart] == ["a", "b"]
    assert apart[0].scales[1] == apart[1].scales[1]
    assert [plot.title for plot in plot_apart(draw, ["b", "c"])] == ["b c"]
    assert [plot.title for plot in plot_apart(draw, ["a"])] == ["a"]


def test_names_of_moments_near_each_other_stand_below_each_other():
    plot = Plot("p", T, Y).line([0.0, 10.0], [0.0, 1.0])
    for at_s in (1.0, 1.2, 1.4, 8.0):
        plot.place(at_s, "a mark that says much")
    heights = re.findall(r'<text class="note[^"]*" x="[\d.]+%" dx="-?4" y="(\d+)"', draw_plot(plot))
    assert heights == ["12", "25", "38", "12"]


def test_the_numbers_beside_an_axis_have_the_room_that_they_need():
    def measure_room(value: float) -> int:
        y = [value, value * 1.00001]
        plot = Plot("p", PlotAxis("time", "s"), PlotAxis("p", "Pa")).line([0.0, 1.0], y)
        page = write_html(Report("p").add(Figure([plot])))
        return int(page.split("--numbers:")[1].split("px")[0])

    assert measure_room(1.0) < measure_room(-1.2345e-9)
    assert measure_room(-1.2345e-9) >= 12 * 7
