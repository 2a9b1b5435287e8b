"""Lesions proposed from an MRI: grown from a point, or where a brain looks unlike a healthy one. Never applied here."""
