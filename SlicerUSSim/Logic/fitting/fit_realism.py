"""measure_fit: the numbers of realism (realism.py) of a fit, for its report and its result."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from SlicerUSSim.Logic.fitting.held_out import as_fitted
from SlicerUSSim.Logic.fitting.prediction import FITTED
from SlicerUSSim.Logic.fitting.realism import UNIFORM, measure_realism
from SlicerUSSim.Logic.fitting.tracked_fit import Fit
from SlicerUSSim.Logic.imaging.simulator import UltrasoundSimulator
from SlicerUSSim.Logic.tracked.images import TrackedImages

#: Names of the images that were simulated before the fit, and of those of the uniform tissue that was fitted
BEFORE, FITTED_UNIFORM = "before the fit", "uniform tissue, fitted"


def measure_fit(
    found: Fit,
    simulator: UltrasoundSimulator,
    *,
    neighbours: Sequence[Sequence[np.ndarray]] | None = None,
    others: TrackedImages | None = None,
    others_neighbours: Sequence[Sequence[np.ndarray]] | None = None,
) -> Fit:
    """The fit with its `realism`, and its prediction with its own.

    Parameters
    ----------
    found, simulator : a fit, and the simulator that it was made with.
    neighbours, others_neighbours : per fitted image, and per image of `others`, real images near it
        (realism.neighbours_of); without them there is no floor.
    others : what held_out.predict was given; needed if the fit has a prediction.

    The images before the fit are measured as well, unless they are of other poses or of tissues that were deformed
    since, where labels would not be those of their pixels.

    Raises SimulationError as measure_realism does.
    """
    result, patient = found.appearance, found.simulator or simulator
    sources = {FITTED: found.after}
    if found.registration is None and found.deformation is None:
        sources[BEFORE] = found.before
    prediction = found.prediction
    with patient.with_tissues(result.tissues):
        realism = measure_realism(found.tracked, sources, patient, neighbours=neighbours, display=result.display)
        if prediction is not None and others is not None:
            predicted = {FITTED: prediction.images[FITTED], FITTED_UNIFORM: prediction.images[UNIFORM]}
            of_others = measure_realism(
                as_fitted(found, others), predicted, patient, neighbours=others_neighbours, display=result.display
            )
            prediction = replace(prediction, realism=of_others)
    return replace(found, realism=realism, prediction=prediction)
