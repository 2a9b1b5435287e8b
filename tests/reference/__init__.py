"""Short references in numpy for single stages, written from the equations of docs/physics.md and not from the kernels.

A reference takes the inputs of its stage as they are on the device: the segments of rays for scatterers, impulses for
the lateral beam and the pulse, the baseband signal for the display. Stages without one are checked against theory by
validation/: rays, borders, walls, beams through tissue, side lobes.
"""
