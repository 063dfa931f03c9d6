"""The envelope on the first screen of a report: its words, and the picture of its tasks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from rig_pages import pendulum, plane

from ctxval.certificates.envelope import Envelope, withdrawn
from ctxval.certificates.envelope_shape import Surfaces
from ctxval.report import ReportContext, context_of_campaign
from ctxval.report.sections.distances import envelope
from facts import assert_names


def with_envelope(dimension: int) -> ReportContext:
    """Return a campaign whose trusted tasks are those with a first parameter in the lower half of its range."""
    context = context_of_campaign(pendulum() if dimension == 1 else plane(dimension))
    points = np.random.default_rng(0).random((200, dimension))
    surfaces = Surfaces.through(points, 2 * points[:, :1])
    known = Envelope(context.space, 0.2, 0.95, "With 95 % confidence.", share=0.5, _surfaces=surfaces)
    return replace(context, envelope=known)


@pytest.mark.parametrize(("dimension", "bands"), [(1, 1), (2, 41), (3, 41)])
def test_each_row_of_a_map_is_shaded_where_tasks_are_trusted(dimension: int, bands: int) -> None:
    context = with_envelope(dimension)
    html = str(envelope(context))
    assert html.count('class="band"') == bands + 1  # and the swatch of the legend
    for label in context.space.labels[:2]:
        assert label in html
    assert ("at " in html.split("<figcaption>")[1]) == (dimension > 2)


def test_one_that_is_withdrawn_has_its_reason_and_no_picture() -> None:
    context = context_of_campaign(plane(2))
    assert str(envelope(context)) == ""
    html = str(envelope(replace(context, envelope=withdrawn(context.space, 0.2, 0.95, "tests are missing."))))
    assert_names(html, "envelope")
    assert "<svg" not in html
