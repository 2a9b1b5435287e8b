"""Validation: the quantities of the model's specification, measured on phantoms and compared with theory.

A check measures one phenomenon for one orientation of its phantom to the voxels, with all probes to which it applies.
Its outcome is rows of a table (predicted, measured, tolerance) and a figure. `python -m validation` runs all checks
(run.py); `python -m validation.realism` compares simulated images with tracked real ones. Part of the checkout, and not
of the installed package.
"""
