"""The Slicer panel: what it does (presenter.py, no Qt) and how it is wired (panel.py)."""
