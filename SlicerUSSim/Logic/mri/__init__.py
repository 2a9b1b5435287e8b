"""Segmentation of an MRI into tissues: guided filter, Gaussian mixture, label map; and sample MRIs.

Independent of ultrasound except for the texture that scatterers may take from the MRI.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .ct import CtSegmentation as CtSegmentation, segment_ct as segment_ct
    from .filtering import guided_filter as guided_filter
    from .lesions.grown_lesion import GrownLesion as GrownLesion
    from .lesions.seeded import grow_lesion as grow_lesion
    from .masks import read_mask as read_mask
    from .pathology import Added as Added, add_tissue as add_tissue, add_tissues as add_tissues
    from .samples import demo_mri as demo_mri, head_mri as head_mri
    from .segmentation import Segmentation as Segmentation, segment_mri as segment_mri
    from .segmentation_settings import SegmentationSettings as SegmentationSettings

lazy_exports(globals())
