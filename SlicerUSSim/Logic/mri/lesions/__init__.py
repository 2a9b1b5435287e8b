"""Lesions grown from a point of an MRI. Never laid over its labels here."""
