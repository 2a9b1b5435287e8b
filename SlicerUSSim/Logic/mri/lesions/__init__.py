"""Lesions proposed from an MRI: grown from a point, or where a brain differs from a healthy one. Never applied alone."""
