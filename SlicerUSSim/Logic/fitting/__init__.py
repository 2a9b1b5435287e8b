"""Fit of simulated to real images: image similarity, free parameters, search, registration, controls, report.

`fit` is the complete fit to tracked images; `optimize_appearance` is the optimisation without registration.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .appearance import AppearanceModel as AppearanceModel
    from .control_costs import Prediction as Prediction, neighbours_of as neighbours_of
    from .fit_settings import FitSettings as FitSettings
    from .held_out import predict as predict
    from .image_similarity import (
        Similarity as Similarity,
        SimilaritySettings as SimilaritySettings,
        similarity as similarity,
    )
    from .optimization import AppearanceResult as AppearanceResult, optimize_appearance as optimize_appearance
    from .parameters import FreeParameters as FreeParameters
    from .registration import Registration as Registration, register_poses as register_poses
    from .report import write_report as write_report
    from .search import Progress as Progress
    from .speckle_fit import SpeckleFit as SpeckleFit, fit_speckle as fit_speckle
    from .speckle_width import SpeckleWidth as SpeckleWidth, speckle_widths as speckle_widths
    from .texture_costs import (
        TextureMisfit as TextureMisfit,
        TextureReference as TextureReference,
        texture_misfit as texture_misfit,
    )
    from .tracked_fit import Fit as Fit, fit as fit

lazy_exports(globals())
