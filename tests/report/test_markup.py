"""Elements and charts: texts are escaped whatever they are, and charts show what they are given."""

from __future__ import annotations

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from markupsafe import Markup

from ctxval.report import Axis, Chart, bullets, element, heading, joined, paragraph, table
from ctxval.report.charts import small_charts
from ctxval.report.markup import code, details, number, percent, quantity, text
from facts import assert_names

HOSTILE = "</script><script>alert('x')</script><img src=x onerror=alert(1)>\"'&\x00\x1b[31m\u202e"


@given(st.text())
def test_no_text_becomes_markup(words: str) -> None:
    found = element("p", words, title=words)
    root = ElementTree.fromstring(re.sub("[\ufffe\uffff]", "", found))
    assert list(root) == []
    assert set(root.attrib) == {"title"}


def test_every_shape_escapes_what_it_is_given() -> None:
    shapes = [
        paragraph(HOSTILE),
        heading(HOSTILE),
        bullets([HOSTILE]),
        table(HOSTILE, [HOSTILE], [[HOSTILE, HOSTILE]]),
        code(HOSTILE, HOSTILE),
        details(HOSTILE, HOSTILE),
        element("p", class_=HOSTILE, data_name=HOSTILE),
        Chart(HOSTILE, Axis(HOSTILE, 0, 1), Axis(HOSTILE, 0, 1))
        .marks([0.5], [0.5], "sample", HOSTILE, [HOSTILE])
        .render(),
    ]
    whole = joined(shapes)
    assert "<script" not in whole
    assert "<img" not in whole
    assert "\x00" not in whole
    assert "\x1b" not in whole
    assert "\u202e" not in whole


def test_markup_stays_and_other_texts_are_shortened() -> None:
    assert text(Markup("<b>x</b>")) == "<b>x</b>"
    assert len(text("x" * 10_000)) < 2_100
    assert element("br") == "<br>"
    assert element("details", open=True) == "<details open></details>"
    assert element("p", None, id=None) == "<p></p>"


def test_numbers_shares_and_quantities() -> None:
    assert (number(0.123456), number(-2), number(-0.0), number(True)) == ("0.1235", "\u22122", "0", "True")
    assert (percent(0.5), percent(1.0), percent(0.99999), percent(1e-9), percent(0.0)) == (
        "50 %", "100 %", "more than 99.9 %", "less than 0.01 %", "0 %",
    )  # fmt: skip
    assert (quantity(1.5, "rad"), quantity(2.0), quantity(None, "m")) == ("1.5 rad", "2", "\u2013")


finite = st.floats(-1e12, 1e12)


@given(arrays(np.float64, st.integers(1, 30), elements=st.floats(allow_nan=True, allow_infinity=True)))
def test_an_axis_holds_all_finite_values_and_has_round_ticks(values: np.ndarray) -> None:
    axis = Axis.over("x", values)
    low, high = axis.ends
    assert low < high
    shown = values[np.isfinite(values) & (np.abs(values) < 1e300)]
    tolerance = 1e-9 * max(abs(low), abs(high))
    assert ((shown >= low - tolerance) & (shown <= high + tolerance)).all()
    ticks = axis.ticks()
    assert len(ticks) <= 20
    assert all(low - 1e-6 * (high - low) <= tick <= high + 1e-6 * (high - low) for tick in ticks)


@given(finite, finite)
def test_steps_of_ticks_are_1_2_2_5_or_5_times_a_power_of_ten(low: float, width: float) -> None:
    axis = Axis("x", low, low + abs(width) + 1e-3 * max(1.0, abs(low)))
    ticks = axis.ticks()
    assert len(ticks) >= 2
    step = ticks[1] - ticks[0]
    digits = step / 10 ** np.floor(np.log10(step) + 1e-9)
    assert min(abs(digits - one) for one in (1, 2, 2.5, 5, 10)) < 1e-3


def make_chart() -> Chart:
    return Chart("Distance over goal", Axis("goal [rad]", 0, 2), Axis("distance [m]", 0, 1))


def test_a_chart_draws_what_it_is_given_where_it_belongs() -> None:
    chart = make_chart().band([0, 1, 2], [0, 0, 0], [1, 1, 1], "band").line([0, 1, 2], [0, 0.5, 1], "mean", "GP")
    chart.marks([1.0], [0.5], "worst", "worst", ["trial 3"]).limit(0.7, "threshold", "threshold")
    found = chart.render()
    assert found.count('class="line mean"') == 2  # one in the chart, one in the legend
    assert "threshold 0.7" in found
    assert "<title>trial 3</title>" in found
    assert "goal [rad]" in found
    assert "<figcaption>" in found
    x, y = float(chart.across(1.0)), float(chart.up(0.5))
    assert f"translate({x:.1f} {y:.1f})" in found
    assert chart.up(1.0) < chart.up(0.0)
    assert repr(chart).startswith("Chart(title='Distance over goal'")


def test_a_limit_outside_a_chart_is_named_and_not_drawn() -> None:
    found = make_chart().limit(5.0, "threshold", "threshold").render()
    assert_names(found, "threshold", 5)
    assert found.count('class="line threshold"') == 1  # the legend alone
    assert "bound" not in make_chart().limit(None, "bound", "bound").render()


def test_a_bound_is_named_rounded_up() -> None:
    assert "bound 0.3746" in make_chart().limit(0.374501, "bound", "bound").render()


def test_values_that_are_not_finite_interrupt_a_line() -> None:
    chart = make_chart().line([0, 0.5, 1, 1.5, 2], [0, 0.2, np.nan, 0.4, 0.5], "mean")
    assert chart.render().count('class="line mean"') == 2
    assert "nan" not in chart.marks([np.inf], [np.nan], "sample").render()


def test_small_charts_share_one_legend() -> None:
    charts = [make_chart().line([0, 1], [0, 1], "model", "model M") for _ in range(3)]
    found = small_charts(charts)
    assert found.count("model M") == 1
    assert found.count("<figure>") == 3


@pytest.mark.slow
def test_a_map_is_a_picture_inside_the_page() -> None:
    assert "data:image/png;base64," in make_chart().image(np.eye(4), 0.0, 1.0).render()


def test_commands_in_paragraphs_are_code_and_nothing_else_is_markup() -> None:
    said = paragraph("say `ctxval run <b>`", element("span", "`a`", title="`b`"))
    assert str(said) == '<p>say <code>ctxval run &lt;b&gt;</code><span title="`b`">`a`</span></p>'
