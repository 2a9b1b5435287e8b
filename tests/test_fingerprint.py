"""Fingerprints of a fit's inputs: equal for equal values, and for nothing else."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import pytest
from hypothesis import given, strategies as st

from SlicerUSSim.Logic import ConvexProbe, DisplaySettings, LinearProbe
from SlicerUSSim.Logic.fitting.optimization import fingerprint

plain = st.none() | st.booleans() | st.integers(-9, 9) | st.floats(-9, 9) | st.text("a1", max_size=3)
values = st.recursive(plain, lambda inner: st.lists(inner, max_size=4).map(tuple), max_leaves=8)


@given(values, values)
def test_two_values_have_one_fingerprint_exactly_if_they_are_equal(one, other):
    assert fingerprint(one) == fingerprint(one)
    assert (fingerprint(one) == fingerprint(other)) == (one == other)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (2**53, 2**53 + 1),
        ("1", 1),
        ([1, [2, 3]], [[1, 2], 3]),
        (["ab", "c"], ["a", "bc"]),
        ([], None),
        ({"gain": 1, "depth": 2}, {"gain": 2, "depth": 1}),
        (np.zeros((2, 3)), np.zeros((3, 2))),
        (np.zeros(2, np.int32), np.zeros(2, np.float32)),
        ([np.zeros(2), np.ones(2)], [np.ones(2), np.zeros(2)]),
        (LinearProbe(20, 30), LinearProbe(20, 31)),
        (DisplaySettings(), DisplaySettings(gain_db=1.0)),
    ],
)
def test_what_differs_has_another_fingerprint(one, other):
    assert fingerprint(one) != fingerprint(other)


def test_numbers_and_arrays_count_by_value_not_by_how_they_are_kept():
    assert fingerprint(1) == fingerprint(1.0) == fingerprint(np.float32(1)) == fingerprint(np.int64(1))
    image = np.arange(12, dtype=np.uint8).reshape(3, 4)
    assert fingerprint(image) == fingerprint(image.copy(order="F")) == fingerprint(np.pad(image, 1)[1:-1, 1:-1])
    one_dot = image.copy()
    one_dot[2, 3] ^= 1
    assert fingerprint([image]) != fingerprint([one_dot])
    assert fingerprint((1, 2)) == fingerprint([1, 2])


def test_a_dataclass_counts_by_its_kind_and_by_what_it_compares():
    @dataclass(frozen=True)
    class Measured:
        value: float
        note: str = field(default="", compare=False)

    @dataclass(frozen=True)
    class Other:
        value: float

    assert fingerprint(Measured(1.0, "a")) == fingerprint(Measured(1.0, "b"))
    assert fingerprint(Measured(1.0)) != fingerprint(Measured(2.0))
    assert fingerprint(Measured(1.0)) != fingerprint(Other(1.0))
    probe = ConvexProbe(40, 60, 80)
    assert fingerprint(probe) == fingerprint(replace(probe)) != fingerprint(replace(probe, scan_lines=100))


@pytest.mark.parametrize("value", [object(), {1, 2}, b"bytes", np.array([object()]), [print]])
def test_what_has_no_fingerprint_is_refused(value):
    with pytest.raises(TypeError, match="no fingerprint of a "):
        fingerprint(value)
