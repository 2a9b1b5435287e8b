"""Tracked real ultrasound: sequences and pose files, the imaged field in images, OpenIGTLink.

File formats of Plus, IGSIO, 3D Slicer and the MNI; world frames are RAS in millimetres.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .imaged_field import ImagedField as ImagedField, draw_field as draw_field, estimate_field as estimate_field
    from .images import TrackedImages as TrackedImages
    from .openigtlink import TrackerLink as TrackerLink
    from .pose_files import (
        read_matrix as read_matrix,
        read_pose as read_pose,
        read_tags as read_tags,
        read_transform as read_transform,
        write_pose as write_pose,
    )
    from .sequence import TrackedSequence as TrackedSequence, frame_numbers as frame_numbers

lazy_exports(globals())
