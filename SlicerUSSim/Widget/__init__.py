"""The panel: what it does (presenter.py, no Qt), wired to Slicer (panel.py), and what it needs (packages.py)."""
