"""Other methods to segment a brain, beside which segment_mri is judged.

Each takes a BrainPhantom and returns (labels, names): (k, j, i) uint8, and the tissue of every label.
"""

from __future__ import annotations

import importlib
import importlib.util

import numpy as np
from scipy import ndimage

from SlicerUSSim.Logic.base.errors import require
from validation.brain_phantoms import MEANS, TISSUES, BrainPhantom

NAMES: dict[int, str] = dict(enumerate(TISSUES[:3], start=1))


def true_thresholds(case: BrainPhantom, contrast: str, smooth: float = 0.0) -> tuple[np.ndarray, dict[int, str]]:
    """Thresholds midway between the true means, on the image without its true bias field.

    A bound of methods that look at the intensity of one voxel alone, and have to find means and bias themselves; with
    a Gaussian of `smooth` voxels inside the mask, of those that smooth by as much.
    """
    image = case.mri.array / case.bias
    if smooth:
        inside = (case.mask.array > 0).astype(np.float32)
        share = np.maximum(ndimage.gaussian_filter(inside, smooth), 1e-3)
        image = ndimage.gaussian_filter(image * inside, smooth) / share
    means = np.array(MEANS[contrast][:3])
    order = np.argsort(means)
    thresholds = 0.5 * (means[order][1:] + means[order][:-1])
    return _inside(order[np.digitize(image, thresholds)] + 1, case), NAMES


def plain_mixture(case: BrainPhantom, contrast: str, seed: int = 0) -> tuple[np.ndarray, dict[int, str]]:
    """A mixture of three normal distributions with free variances on the intensities as they are, from scikit-learn.

    Starts from Otsu's thresholds, as this project did before it had classes for partial volumes. 200 000 voxels.
    """
    from skimage.filters import threshold_multiotsu

    require(importlib.util.find_spec("sklearn") is not None, "plain mixture needs the package scikit-learn")
    mixture = importlib.import_module("sklearn.mixture")
    values = case.mri.array[case.mask.array > 0]
    some = np.random.default_rng(seed).choice(values, min(values.size, 200_000), replace=False)
    member = np.digitize(some, threshold_multiotsu(some, classes=3))
    start = np.array([[some[member == n].mean()] for n in range(3)])
    model = mixture.GaussianMixture(3, means_init=start, random_state=seed, max_iter=300).fit(some[:, None])
    return _in_order(model.predict(values[:, None]), values, case, contrast)


def atropos(case: BrainPhantom, contrast: str, n4: bool = False) -> tuple[np.ndarray, dict[int, str]]:
    """ANTs' Atropos with k-means and a Markov random field (Avants et al., Neuroinformatics 9(4), 2011), raw or after
    N4.

    N4 is SimpleITK's with its defaults on an image shrunken four times: ANTsPy's defaults, which iterate longer, leave
    7 % of bias in the phantoms, and these 2 %.

    Raises SimulationError if antspyx is not installed.
    """
    require(importlib.util.find_spec("ants") is not None, "Atropos needs ANTs: pip install antspyx")
    ants = importlib.import_module("ants")
    # The transform to RAS does not matter here: the method works on the grid, in millimetres.
    spacing = case.mri.spacing_mm.tolist()

    def image(array: np.ndarray):
        return ants.from_numpy(np.ascontiguousarray(array.T.astype(np.float32)), spacing=spacing)

    inside = case.mask.array > 0
    intensity = _without_bias(case) if n4 else case.mri.array
    box = ndimage.find_objects(np.asarray(case.mask.array))[0]  # half the voxels, half the time
    found = ants.atropos(a=image(intensity[box]), m="[0.1,1x1x1]", c="[5,0]", i="kmeans[3]", x=image(inside[box]))
    member = np.rint(found["segmentation"].numpy().T[inside[box]]).astype(int)
    return _in_order(member, intensity[inside], case, contrast)


def _without_bias(case: BrainPhantom) -> np.ndarray:
    import SimpleITK as sitk

    image, mask = case.mri.to_sitk(), case.mask.to_sitk()
    shrink = [4 if size >= 128 else 2 for size in image.GetSize()]
    corrector = sitk.N4BiasFieldCorrectionImageFilter()
    corrector.Execute(sitk.Shrink(image, shrink), sitk.Shrink(mask, shrink))
    return case.mri.array / np.exp(sitk.GetArrayFromImage(corrector.GetLogBiasFieldAsImage(image)))


def _in_order(member: np.ndarray, values: np.ndarray, case: BrainPhantom, contrast: str):
    """Classes named by the order of their mean intensity."""
    classes = sorted(np.unique(member), key=lambda n: values[member == n].mean())
    by_mean = np.argsort(MEANS[contrast][:3])
    labels = np.zeros(case.mask.array.shape, np.uint8)
    inside = np.zeros(member.shape, np.uint8)
    for rank, number in enumerate(classes):
        inside[member == number] = by_mean[min(rank, 2)] + 1
    labels[case.mask.array > 0] = inside
    return labels, NAMES


def _inside(labels: np.ndarray, case: BrainPhantom) -> np.ndarray:
    return np.where(case.mask.array > 0, labels, 0).astype(np.uint8)
