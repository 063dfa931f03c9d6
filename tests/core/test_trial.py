"""Tests of stored trials."""

import numpy as np
import pytest

from ctxval.core.trial import Trial
from ctxval.core.trial_note import TrialNote


@pytest.mark.parametrize("ends", [{}, {"system": None}, {"system": "soon"}, [1.0], 2.0])
def test_a_note_that_says_no_time_of_an_end_is_no_end(ends: object) -> None:
    trial = Trial(0, "iid", "failed", np.zeros(1), {}, note=TrialNote.from_json({"ends": ends}))
    assert trial.ended_alone is None
    assert trial.least == 0.0
