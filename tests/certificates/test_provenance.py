from __future__ import annotations

import numpy as np

from ctxval import TaskSpace
from ctxval.certificates import Provenance
from ctxval.core.trial import Change
from facts import assert_names


def test_what_was_changed_in_a_store_is_remarked() -> None:
    changes = [
        Change("accepted", "gripper replaced", {"differences": ["x was 1 and is now 2", "y is new"], "trials": 7}),
        Change("remeasured", "another norm", {"before": {}}),
    ]
    assert_names(Provenance.of({}, changes).remarks, 7, "trials", "gripper replaced", "another norm")


def test_what_a_store_describes_is_read() -> None:
    space = {"type": "TaskSpace", "goal": [-1.0, 1.0, "rad"], "load[0]": [0.0, 1.0, "kg"], "load[1]": [0.0, 2.0, "kg"]}
    known = Provenance.of({"validation": {"space": space}})
    assert isinstance(known.space, TaskSpace)
    assert known.space.names == ("goal", "load[0]", "load[1]")
    assert known.space.units == {"goal": "rad", "load": "kg"}
    np.testing.assert_array_equal(known.space.high, [1.0, 1.0, 2.0])


def test_what_a_store_does_not_describe_is_not_known() -> None:
    for description in ({}, {"validation": {"space": {"goal": "anything"}}}):
        known = Provenance.of(description)
        assert (known.space, known.remarks) == (None, ())
