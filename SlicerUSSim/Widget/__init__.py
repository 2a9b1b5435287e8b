"""The panel: what it does (presenter.py, no Qt), wired to Slicer (panel.py), and the packages it needs (packages.py)."""
