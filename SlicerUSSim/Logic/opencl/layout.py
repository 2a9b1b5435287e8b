"""The structs and constants shared by host and kernels, defined once as numpy dtypes.

Every member is four bytes wide, so the packed layout of numpy and that of C agree on every device.
"""

from __future__ import annotations

import numpy as np

from SlicerUSSim.Logic.base.declaration import parameters_of
from SlicerUSSim.Logic.base.settings import DisplaySettings

#: Constants with the same name in host and kernels.
CONSTANTS = {
    "LABEL_MASK": 0x3F,  # low byte of a medium voxel: six bits of label, ...
    "SAME_LABEL": 0x40,  # ... one bit that is set if all eight voxels of this cell have one label, ...
    "NO_MEMBRANE": 0x80,  # ... and one that is set if no membrane passes between them
    "PLAIN_CELL": 0xC0,  # both
    "GROUP_MASK": 0x7F,
    "SAME_GROUP": 0x80,  # added to the acoustic group of a voxel: all eight voxels of this cell have the same group
    "MEMBRANE_LABEL": 63,
    "ON_SHEET": 0x40,  # added to the label of a scatterer in a sheet of the dura's own tissue (scattering.cl)
    "MAX_TISSUES": 64,
    # Of the Gaussians that smooth the indicators of acoustic groups (borders.py), in voxels: at full resolution, and
    # after that at half the resolution. The variances belong to the Gaussians that they resemble near their centre:
    # more than of their taps, since they are cut off
    "WIDE_SIGMA": 3.0,
    "WIDE_VARIANCE": 8.91,
    "HALVED_SIGMA": 4.0,
    "WIDEST_VARIANCE": 18.29,
    "SHEET_SIGMA": 2.0,  # of the window in which sheets are fitted (sheets.cl), voxels, ...
    "SHEET_REACH": 4,  # ... and where it is cut off
    # Of the sheet's indicator, smoothed by 0.75 voxel: a layer of one voxel reaches 0.5, of two 0.82; from this on a
    # layer is thick and has two borders
    "SHEET_THICK": 0.9,
    "SHEET_LEAST_AREA": 2.5,  # of a sheet in it: product of the variances along a plane, voxels^4; of a whole one 16
    "SHEET_DISTANCE_STEP": 0.015625,  # of the stored distance, voxels
    # Of sheets found in the MRI (found_sheets.py): half the thickness in mm, level in dB, reflection coefficient
    "SHEET_HALF_STEP": 0.0078125,
    "SHEET_LEVEL_STEP_DB": 0.5,
    "SHEET_REFLECTION_STEP": 0.008,
    "TEXTURE_STEP_DB": 0.1,  # of the gain in texture.py
    "UNEVEN_WORDS": 8,  # per label, of scattering.py
    "MAX_SEGMENTS": 256,  # per traced line
    "MAX_HITS": 96,  # per traced ray
    "SOFT_SPEED": 0.105,  # largest relative difference of speed of sound at a soft border (common.clh), ...
    "SOFT_REFLECTION": 0.12,  # ... and largest reflection coefficient at normal incidence
    "STRAIGHT_SPEED": 0.2,  # ... and largest relative difference of speed at which a path goes straight on
    # Nepers per mm (both ways) from which tissue, as bone marrow, leaves nothing of a beam within a few mm: its borders
    # with other tissue are strong
    "LOSSY_PER_MM": 0.8,
    "MAX_STACK": 24,  # reflected rays waiting to be followed
    "BLOCK": 64,  # samples over which beam widths and gains are assumed linear; lines are whole blocks long
    "PARTS": 4,  # of the echoes, which are computed at once for fits (scattering.cl)
    "LOSS_STEP": 16,  # samples between those at which losses are stored (downshift.cl); a multiple of all LANES
    "MAX_ZONES": 8,  # of a transmit beam: probe.beam.MOST_ZONES
    "LOBE_DEPTHS": 33,  # of the tables of side lobes (diffraction.py), from the face to the image depth, ...
    "LOBE_DISTANCES": 65,  # ... and lateral distances from the axis
    "PLANE_DEPTHS": 17,  # of the table of planes' echoes (diffraction.py), from the face to the image depth, ...
    "PLANE_TILTS": 65,  # ... and roots of tangents of tilts, from 0 to 1
    "LENS_DISTANCES": 129,  # distances from the axis of the elevational tables (probe/lens.py)
    "LOBE_STEP": 0.75,  # ... which are so far apart laterally, in wavelengths x receive f-number
    "LOBE_NODES": 128,  # places across the image for which lateral side lobes are computed, at most
    "MAX_BINS": 256,  # of the histograms in similarity.cl
    "LINE_PAD": 448,  # zeros on either side of a line: the longest pulse filter (bandwidth 0.05, 16 samples per cycle)
}

_FLOAT, _INT, _UINT = np.float32, np.int32, np.uint32

#: Fields called as a parameter of Probe or SimulationSettings have its value, unless the simulator says otherwise.
ACQUISITION = np.dtype(
    [
        # medium
        ("ras_to_voxel", _FLOAT, 12),  # rows of the affine map from RAS mm to padded voxel indices (i, j, k)
        ("dims", _INT, 3),  # padded voxels along i, j, k
        ("voxel_mm", _FLOAT),  # smallest spacing
        ("smooth_groups", _INT),  # acoustic groups with a smoothed indicator
        ("membrane_reach", _FLOAT),  # half the membrane in units of the fluid distance (0..255); negative: none
        (
            "sheet_label",
            _INT,
        ),  # of the membrane's own tissue, a sheet where it is thin; -1: no sheets; 64: none of labels
        ("dura_label", _INT),  # of the tissue of falx and tentorium that were found, if sheets have it
        ("sheet_reach_mm", _FLOAT),  # half the thickness of such a sheet
        ("membrane_gain", _FLOAT),  # of the amplitude of its scatterers at normal incidence
        ("membrane_exponent", _FLOAT),  # of the cosine of incidence by which it falls on walls, and on sheets
        ("sheet_exponent", _FLOAT),
        ("dura_isotropic", _FLOAT),  # part of the power of falx and tentorium that were found that does not fall
        ("patches_per_mm", _FLOAT),  # one over the size of its patches, and octaves by which they differ in roughness
        ("membrane_variation", _FLOAT),
        ("membrane_octaves", _FLOAT),  # and in amplitude
        ("membrane_phase", _FLOAT),  # deviation of the echo's phase by its roughness, radians at normal incidence
        # probe and pose
        ("probe_to_ras", _FLOAT, 12),
        ("linear", _INT),
        ("apex_radius_mm", _FLOAT),
        ("first_line", _FLOAT),
        ("line_spacing", _FLOAT),
        ("scan_lines", _INT),
        ("depth_mm", _FLOAT),  # displayed, of the image
        ("traced_mm", _FLOAT),  # displayed, up to which rays are traced: half a pulse and a voxel beyond the image
        # steering of a linear array (line_start in common.clh)
        ("steered", _INT),
        ("flat_face", _INT),
        ("steering_sin", _FLOAT),  # of the angle of parallel lines to the normal of the face
        ("steering_cos", _FLOAT),
        ("start_mm", _FLOAT),  # displayed depth at which a parallel line in the middle leaves the face
        ("top_mm", _FLOAT),  # of the imaged field
        ("bottom_mm", _FLOAT),
        ("face_reflection", _FLOAT),  # of the amplitude by the probe's face; 0: none
        ("face_half_mm", _FLOAT),  # half the size of the face, laterally and elevationally
        ("face_half_height_mm", _FLOAT),
        # wave and beam (Probe.beam_sigma_mm)
        ("frequency_mhz", _FLOAT),
        ("fractional_bandwidth", _FLOAT),
        ("reference_speed_m_s", _FLOAT),
        ("cycles_per_mm", _FLOAT),
        ("sample_mm", _FLOAT),
        ("samples", _INT),  # up to traced_mm, rounded up to whole blocks
        ("transmit_zones", _INT),  # 0: focused at every depth, with transmit_sigma[0] at least
        ("transmit_sigma", _FLOAT, CONSTANTS["MAX_ZONES"]),
        ("transmit_focus", _FLOAT, CONSTANTS["MAX_ZONES"]),
        ("transmit_rayleigh", _FLOAT, CONSTANTS["MAX_ZONES"]),
        ("transmit_waist", _FLOAT),  # the shortest of these
        ("transmit_sigma_slope", _FLOAT),  # where focused at every depth
        ("wavefront_curvature", _FLOAT),  # laterally, probe.beam.CURVED; 0: none
        ("receive_sigma_min", _FLOAT),
        ("receive_sigma_slope", _FLOAT),
        ("elevation_sigma", _FLOAT, CONSTANTS["LOBE_DEPTHS"]),  # LensBeam.sigma_mm
        ("elevation_focus", _FLOAT),
        ("elevation_rayleigh", _FLOAT),
        # beams from an aperture (aperture.cl)
        ("aperture_beams", _INT),
        ("aperture_mm", _FLOAT),
        ("receive_f_number", _FLOAT),
        ("screen_lines", _INT),
        ("screen_depths", _INT),
        ("screen_step", _FLOAT),  # millimetres of path
        ("fan_points", _INT),
        ("fan_first", _FLOAT),  # place of the first point along the face, mm
        ("fan_pitch", _FLOAT),
        ("fan_angles", _INT),
        ("fan_first_angle", _FLOAT),  # to the normal of the face, radians
        ("fan_angle_step", _FLOAT),
        ("fan_depths", _INT),  # from 0 on
        ("fan_step", _FLOAT),  # between them, mm
        # ray tree
        ("max_ray_depth", _INT),
        ("intensity_threshold", _FLOAT),
        ("reflection_threshold", _FLOAT),
        ("reflection_spreading", _INT),
        ("elevational_rays", _INT),
        ("lateral_rays", _INT),  # traced lines per scan line
        ("guard_lines", _INT),  # traced lines beyond either edge of the field
        ("traced_lines", _INT),
        ("interface_gain", _FLOAT),
        ("interface_is_energy", _INT),
        ("specular_exponent", _FLOAT),
        ("downshift", _FLOAT),  # part of the frequency that is lost per neper of two-way loss; 0: none
        ("band_above", _FLOAT),  # log erfc(-f0 / sf): of the part of the transmitted band that is above zero
        # scatterers
        ("cell_mm", _FLOAT),
        ("seed", _UINT),
        ("beam_cutoff", _FLOAT),
        ("speckle_scale", _FLOAT),  # 1 / sqrt(density pi^1.5 axial sigma): unit variance gives unit mean square
    ]
)

#: All but the last two are attributes of a Tissue, by which the medium fills them.
TISSUE = np.dtype(
    [
        ("speed_of_sound_m_s", _FLOAT),
        ("impedance_mrayl", _FLOAT),
        ("attenuation_db_cm_mhz", _FLOAT),
        ("scatterer_share", _FLOAT),  # p = 1 - Phi(mu1)
        ("scatterer_variance", _FLOAT),
        ("texture_db", _FLOAT),
        ("texture_mm", _FLOAT),
        ("specks_per_mm3", _FLOAT),
        ("speck_db", _FLOAT),
        ("group", _INT),  # tissues of one speed and impedance: no interface between them
        ("label_of_group", _INT),  # one that is in the acoustic group of this row's number; -1: no such group
        ("is_fluid", _INT),  # of the membrane's fluids
    ]
)

#: One straight piece of a traced line's ray tree, in one tissue. (xyz triples are RAS mm.)
SEGMENT = np.dtype(
    [
        ("start", _FLOAT, 3),
        ("direction", _FLOAT, 3),
        ("lateral", _FLOAT, 3),
        ("elevational", _FLOAT, 3),
        ("tube", _FLOAT, 4),  # spreading at `start`: lateral width, growth per mm, elevational width, growth per mm
        ("path_mm", _FLOAT),  # unfolded path length from the probe face at `start`: sets the beam width
        ("length_mm", _FLOAT),
        ("depth_mm", _FLOAT),  # t c_ref / 2 at `start`: the displayed depth
        ("depth_per_mm", _FLOAT),  # c_ref / c
        ("weight", _FLOAT),  # product of R and 1 - R along the path
        ("attenuation", _FLOAT),  # two-way amplitude factor at `start`
        ("decay_per_mm", _FLOAT),  # -d ln(attenuation) / ds
        ("loss", _FLOAT),  # nepers at `start` by the attenuation of tissues alone, without what a beam loses otherwise
        ("loss_per_mm", _FLOAT),
        # The borders of its strip (strips.cl): lateral offset at `start`, its change per mm along the segment, what the
        # displayed depth changes per mm of offset from the axis towards that border, its change
        ("left", _FLOAT, 4),
        ("right", _FLOAT, 4),
        ("reflections", _INT),
        ("label", _INT),
    ]
)

#: One crossing of a tissue interface by one ray.
HIT = np.dtype(
    [
        ("position", _FLOAT, 3),
        ("normal", _FLOAT, 3),  # unit, against the ray
        ("path_mm", _FLOAT),
        ("depth_mm", _FLOAT),
        ("weight", _FLOAT),
        ("attenuation", _FLOAT),
        ("loss", _FLOAT),  # as in a segment
        ("cos_incidence", _FLOAT),
        ("reflectance", _FLOAT),  # R = r^2
        # depth (displayed) per mm of lateral offset along the interface, in the unfolded beam
        ("lateral_slope", _FLOAT),
        ("elevational_slope", _FLOAT),  # the same for elevational offset
        ("curvature", _FLOAT),  # mean curvature of the interface in 1/mm, positive where convex against the ray
        ("elevational_mm", _FLOAT),  # the ray's offset from the beam axis
        ("echo", _FLOAT),  # amplitude of a perpendicular interface over the whole beam, signed as r
        ("reflections", _INT),
        ("label_before", _INT),
        ("label_behind", _INT),
    ]
)

#: The part of an interface echo near one hit, along the traced line and beside it (interfaces.cl).
WALL = np.dtype(
    [
        ("depth_mm", _FLOAT),  # on the traced line
        ("depth_per_line", _FLOAT),  # its change per traced line of distance to the scan line
        ("echo", _FLOAT),  # amplitude on the traced line, ...
        ("fall", _FLOAT),  # ... and its exponent of two per squared traced line
        ("reach", _FLOAT),  # traced lines up to the cut-off of the beam
    ]
)

#: The numbers of DisplaySettings by their names, for kernels of display stages; nan stands for None.
DISPLAY = np.dtype([(entry.name, _FLOAT) for entry in parameters_of(DisplaySettings) if entry.type in (int, float)])

_C_TYPES = {np.dtype(_FLOAT): "float", np.dtype(_INT): "int", np.dtype(_UINT): "uint"}


def _c_struct(name: str, dtype: np.dtype) -> str:
    members = []
    for field_name in dtype.names or ():
        base, shape = dtype[field_name].base, dtype[field_name].shape
        members.append(f"  {_C_TYPES[base]} {field_name}{f'[{shape[0]}]' if shape else ''};")
    return "\n".join(["typedef struct {", *members, f"}} {name};"])


def shared_source() -> str:
    """C source of all constants and structs above; Device.kernels prepends it to a kernel file."""
    constants = [f"#define {name} {value}{'f' * isinstance(value, float)}" for name, value in CONSTANTS.items()]
    dtypes = {
        "Acquisition": ACQUISITION,
        "Display": DISPLAY,
        "Tissue": TISSUE,
        "Segment": SEGMENT,
        "Hit": HIT,
        "Wall": WALL,
    }
    return "\n".join(constants + [_c_struct(name, dtype) for name, dtype in dtypes.items()])
