"""Random probes, settings, tissues, labels and poses, each within what is declared as valid.

    USSIM_FUZZ=10000 python -m pytest tests/test_random_inputs.py

What comes of them is a finite image that is the same the second time, or one line that refuses them.
"""

from __future__ import annotations

import os
import re
import warnings
from dataclasses import replace
from typing import Any, get_args, get_origin

import numpy as np
import pytest
from hypothesis import HealthCheck, event, given, settings, strategies as st
from scipy.spatial.transform import Rotation

from SlicerUSSim.Logic import (
    ConvexProbe,
    DisplaySettings,
    LinearProbe,
    PhasedProbe,
    SimulationError,
    SimulationSettings,
    Texture,
    Tissue,
    TissueTable,
    UltrasoundSimulator,
    Volume,
)
from SlicerUSSim.Logic.base.declaration import Parameter, parameters_of
from SlicerUSSim.Logic.imaging.simulator import SlowScatterersWarning

#: What makes an image large without making it another one
SMALL = {
    "scan_lines": (2, 24), "depth_mm": (1.0, 40.0), "image_size": (8, 64), "elevational_rays": (1, 8),
    "lateral_rays": (0, 8), "scatterers_per_mm3": (0.5, 60.0), "samples_per_cycle": (3, 8), "max_ray_depth": (0, 6),
}  # fmt: skip


def numbers(low: float, high: float, is_whole: bool) -> st.SearchStrategy[Any]:
    """Between bounds, and often at them; of every magnitude where they span several."""
    if is_whole:
        return st.one_of(st.integers(int(low), int(high)), st.sampled_from([int(low), int(high)]))
    found = [st.floats(low, high), st.sampled_from([float(low), float(high)])]
    if low > 0 and high > 30 * low:
        found.append(st.floats(np.log(low), np.log(high)).map(lambda x: float(np.clip(np.exp(x), low, high))))
    return st.one_of(found)


def values(parameter: Parameter) -> st.SearchStrategy[Any]:
    """Valid values of a parameter."""
    kind = get_origin(parameter.type) or parameter.type
    if parameter.choices:
        found: st.SearchStrategy[Any] = st.sampled_from(parameter.choices)
    elif kind is bool:
        found = st.booleans()
    else:
        elements = get_args(parameter.type) if kind is tuple else ()
        low, high = SMALL.get(parameter.name) or parameter.bounds or (0.0, 1.0)
        is_whole = int in (kind, *elements)
        found = numbers(low, high, is_whole)
        if elements:
            found = st.tuples(*[found] * len(elements))
    return st.one_of(st.none(), found) if parameter.can_be_none else found


def some(owner: type, leave: tuple[str, ...] = ()) -> st.SearchStrategy[dict[str, Any]]:
    """Values of some parameters of a declared class, and of all that are required or make images large."""
    known = [p for p in parameters_of(owner) if p.name not in leave and (p.bounds or p.choices or p.type is bool)]
    needed = {p.name: values(p) for p in known if p.is_required or p.name in SMALL}
    return st.fixed_dictionaries(needed, optional={p.name: values(p) for p in known if p.name not in needed})


@st.composite
def label_maps(draw) -> Volume:
    """Up to 14 voxels along each axis, turned and stretched, of noise or of blocks."""
    shape = draw(st.tuples(*[st.integers(1, 14)] * 3))
    rng = np.random.default_rng(draw(st.integers(0, 999)))
    array = rng.integers(0, 4, shape).astype(np.uint8)
    if draw(st.booleans()):
        array = np.sort(array, axis=draw(st.integers(0, 2)))
    matrix = np.eye(4)
    turned = Rotation.from_quat(rng.normal(size=4)).as_matrix() if draw(st.booleans()) else np.eye(3)
    matrix[:3, :3] = turned * draw(st.tuples(*[st.sampled_from([0.05, 0.5, 1.0, 3.0, 20.0])] * 3))
    matrix[:3, 3] = -matrix[:3, :3] @ (np.array(shape[::-1]) / 2) + [0.0, 8.0, 0.0]
    return Volume(array, matrix)


@st.composite
def poses(draw) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_rotvec(draw(st.tuples(*[st.floats(-3, 3)] * 3))).as_matrix()
    pose[:3, 3] = draw(st.tuples(*[st.sampled_from([0.0, -3.0, 5.0, 200.0])] * 3))
    return pose


def built(owner: type, chosen: dict[str, Any]) -> Any:
    """The object, with defaults where values do not go together; None if they do not without."""
    required = {p.name for p in parameters_of(owner) if p.is_required} | SMALL.keys()
    for kept in (chosen, {name: chosen[name] for name in chosen if name in required}):
        try:
            return owner(**kept)
        except SimulationError as error:
            assert "\n" not in str(error)
    return None


def drawn(examples: int) -> settings:
    """So many scenes, the same every time."""
    return settings(
        max_examples=examples, deadline=None, derandomize=True, database=None,
        suppress_health_check=list(HealthCheck),
    )  # fmt: skip


@drawn(6)
@given(st.data())
def test_valid_values_give_a_finite_image_twice_or_are_refused_in_one_line(data):
    _simulate_twice(data)


@pytest.mark.slow
@drawn(int(os.environ.get("USSIM_FUZZ", "25")))
@given(st.data())
def test_many_valid_values_give_a_finite_image_twice_or_are_refused(data):
    _simulate_twice(data)


def _simulate_twice(data) -> None:
    array = data.draw(st.sampled_from([LinearProbe, ConvexProbe, PhasedProbe]))
    probe = built(array, data.draw(some(array)))
    chosen = built(SimulationSettings, data.draw(some(SimulationSettings)))
    display = built(DisplaySettings, data.draw(some(DisplaySettings)))
    tissue = built(Tissue, {"name": "drawn", "speed_of_sound_m_s": 1540.0, "impedance_mrayl": 1.6,
                            "attenuation_db_cm_mhz": 0.5, **data.draw(some(Tissue, ("name",)))})  # fmt: skip
    if probe is None or tissue is None:
        event("no such probe or tissue")
        return
    table = TissueTable.named(["csf", "grey matter", "bone", "white matter"])
    table = TissueTable({**table, 1: replace(tissue, name="drawn")})
    labels, pose = data.draw(label_maps()), data.draw(poses())
    rng = np.random.default_rng(data.draw(st.integers(0, 999)))
    share, part = rng.uniform(0, 0.5, (2, *labels.array.shape)).astype(np.float32)
    second = rng.integers(0, 4, labels.array.shape).astype(np.uint8)
    texture = Texture(second, share, rng.normal(size=share.shape).astype(np.float32), part)
    images = []
    for _ in range(2):
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")
                warnings.simplefilter("error", SlowScatterersWarning)
                frame = UltrasoundSimulator(labels, table, chosen, texture=texture).simulate(probe, pose, display)
        except (SimulationError, SlowScatterersWarning) as error:
            assert str(error) and "\n" not in str(error)
            images.append(str(error))
            event("refused: " + re.sub(r"[\d.e+-]+", "#", str(error))[:60])
            continue
        assert frame.image.dtype == np.uint8 and np.isfinite(frame.iq).all()
        event("an image with echoes" if frame.image.any() else "a black image")
        images.append((frame.image.tobytes(), frame.iq.tobytes()))
    assert images[0] == images[1]
