"""The probe: array and beam, image pixels, shape, and placement on a patient.

Probe frame: x lateral, y depth, z elevational, millimetres, origin in the middle of the probe face.
"""

from typing import TYPE_CHECKING

from SlicerUSSim.Logic.base.lazy import lazy_exports

if TYPE_CHECKING:
    from .arrays import (
        PROBES as PROBES,
        ConvexProbe as ConvexProbe,
        LinearProbe as LinearProbe,
        PhasedProbe as PhasedProbe,
        Probe as Probe,
        probe_from_dict as probe_from_dict,
    )
    from .image_grid import ImageGrid as ImageGrid
    from .poses import (
        aimed_at as aimed_at,
        carried as carried,
        craniotomy_pose as craniotomy_pose,
        pose_in_slice as pose_in_slice,
        pose_looking_at as pose_looking_at,
        slice_under_probe as slice_under_probe,
        slide_sweep as slide_sweep,
        tilt_sweep as tilt_sweep,
        turned as turned,
    )
    from .shape import (
        field_polydata as field_polydata,
        outline_polydata as outline_polydata,
        probe_polydata as probe_polydata,
    )
    from .surface import PatientSurface as PatientSurface, SurfacePose as SurfacePose

lazy_exports(globals())
