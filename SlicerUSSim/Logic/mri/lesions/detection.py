"""propose_lesions: where a brain looks unlike a healthy one, without a point from the user.

Outliers of the mixture alone are found in every brain: vessels, nuclei, mixed voxels. So what is proposed has to be
compact, of an intensity that the place does not explain (the atlas expects white matter there), and absent in the
other hemisphere.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING, cast

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from SlicerUSSim.Logic.mri.evidence import Evidence
from SlicerUSSim.Logic.mri.lesions.doubts import beside_no_tissue, why_no_lesion
from SlicerUSSim.Logic.mri.lesions.growth import smoothed
from SlicerUSSim.Logic.mri.lesions.looks import (
    brighter_than_white,
    enhancing,
    typically_watery,
    watery,
    watery_likeness,
    watery_weights,
)
from SlicerUSSim.Logic.mri.lesions.proposal import Proposal
from SlicerUSSim.Logic.mri.lesions.seeded import Grown, grown_by, proposal_of

if TYPE_CHECKING:
    from SlicerUSSim.Logic.mri.segmentation import Segmentation

_WHITE = 2
#: Least likeness to typical watery tissue, share of white matter that the atlas expects, and difference from the other
#: hemisphere
_LEAST_LIKENESS, _LEAST_WHITE, _LEAST_DIFFERENCE = 0.7, 0.5, 0.4
#: Radius of the smallest ball in a candidate, and least volumes of what is proposed
_WATERY_MM, _ENHANCING_MM = 4.0, 1.4
_LEAST_WATERY_ML, _LEAST_ENHANCING_ML = 2.0, 0.2
#: What enhances is proposed where it is surrounded by tissue, and no nearer than this to the surface of the brain
_MOST_BESIDE_NO_TISSUE, _DEEP_MM = 0.08, 5.0
#: Least mean share of white matter that the atlas expects there, and largest of CSF: sinuses and veins are elsewhere,
#: and choroid plexus in a ventricle
_ENHANCING_IN_WHITE, _MOST_CSF = 0.4, 0.2
#: Most places that are tried for each look
_MOST_PLACES = 8
_SIGMA_MM, _OTHER_SIGMA_MM = 1.5, 3.0


def propose_lesions(segmentation: Segmentation) -> tuple[Proposal, ...]:
    """What looks like lesions, the largest first; none in a healthy brain. The segmentation stays as it is.

    Found are regions of 2 ml and more in white matter that are bright in T2 or FLAIR or dark in T1, and of 0.2 ml and
    more that enhance within tissue. Smaller ones, those at the surface, and what lies at the midline are only grown
    from a point (grow_lesion). Takes some seconds.

    Raises SimulationError for a segmentation without the atlas, which tells what healthy tissue is expected where.
    """
    evidence = segmentation.evidence
    require(
        evidence.atlas is not None,
        "lesions are proposed by the atlas, which this segmentation lacks (its notes say why); expected a whole brain "
        "and nilearn, or a point in the lesion",
    )
    found: list[tuple[Grown, np.ndarray]] = []
    taken = np.zeros(evidence.inside.shape, bool)
    for look, places in ((enhancing, _enhancing_places(evidence)), (watery, _watery_places(evidence))):
        for place in places:
            if taken[tuple(place)]:
                continue
            grown = grown_by(look, evidence, place)
            if grown is None or not _is_sure(evidence, grown):
                continue
            found.append((grown, place))
            taken |= grown.in_box(evidence)
    proposals: list[Proposal] = []
    covered = np.zeros(evidence.shape, bool)
    for grown, place in found:
        proposal = proposal_of(segmentation, grown, evidence.ras_of(place), None)
        new = proposal.labels.array > 0
        if (new & covered).sum() < 0.5 * new.sum():
            proposals.append(proposal)
            covered |= new
    return tuple(sorted(proposals, key=lambda proposal: -proposal.volume_ml()))


def _is_sure(evidence: Evidence, grown: Grown) -> bool:
    """Whether nothing speaks against a lesion, more strictly than with a point from the user."""
    look, region, window = grown.look, grown.region, grown.window
    volume = region.volume_ml(evidence.spacing_mm)
    if why_no_lesion(evidence, look, region, window) is not None:
        return False
    if look.name == "enhancing":
        if evidence.expected is None:
            return False
        csf, _, white = (float(share[window][region.inside].mean()) for share in evidence.expected)
        beside = beside_no_tissue(evidence, region, window)
        is_in_white = white >= _ENHANCING_IN_WHITE and csf <= _MOST_CSF
        return volume >= _LEAST_ENHANCING_ML and beside <= _MOST_BESIDE_NO_TISSUE and is_in_white
    return volume >= _LEAST_WATERY_ML


def _watery_places(evidence: Evidence) -> Iterator[np.ndarray]:
    """Places (k, j, i) in the middle of compact watery regions where white matter is expected."""
    weights = watery_weights(evidence, typically_watery(evidence))
    if weights is None or evidence.expected is None:
        return
    likeness = watery_likeness(evidence, evidence.images, weights)
    tissue = evidence.inside & ~evidence.fluid
    smooth = smoothed(likeness, tissue, evidence.spacing_mm, _OTHER_SIGMA_MM)
    other = cast(np.ndarray, evidence.mirrored(np.where(tissue, smooth, 0.0).astype(np.float32)))
    candidate = tissue & (smoothed(likeness, tissue, evidence.spacing_mm, _SIGMA_MM) > _LEAST_LIKENESS)
    candidate &= (evidence.expected[_WHITE] > _LEAST_WHITE) & (smooth - other > _LEAST_DIFFERENCE)
    yield from _middles(candidate, evidence, _WATERY_MM)


def _enhancing_places(evidence: Evidence) -> Iterator[np.ndarray]:
    """Places (k, j, i) in the middle of compact regions that enhance, deep in the brain."""
    channel = evidence.channel("t1gd")
    if channel is None:
        return
    image = smoothed(evidence.images[channel], evidence.inside, evidence.spacing_mm, 1.0)
    depth = cast(np.ndarray, ndimage.distance_transform_edt(evidence.inside, sampling=evidence.spacing_mm.tolist()))
    candidate = (image > brighter_than_white(evidence, channel)) & (depth > _DEEP_MM)
    yield from _middles(candidate, evidence, _ENHANCING_MM)


def _middles(candidate: np.ndarray, evidence: Evidence, radius_mm: float) -> Iterator[np.ndarray]:
    """The innermost place of every part that holds a ball of a radius, the thickest first."""
    depth = cast(np.ndarray, ndimage.distance_transform_edt(candidate, sampling=evidence.spacing_mm.tolist()))
    parts, count = ndimage.label(candidate)  # type: ignore[misc]
    if not count:
        return
    deepest = np.atleast_1d(ndimage.maximum(depth, parts, np.arange(1, count + 1)))
    for number in np.argsort(-deepest, kind="stable")[:_MOST_PLACES]:
        if deepest[number] >= radius_mm:
            yield np.array(ndimage.maximum_position(depth, parts, number + 1))
