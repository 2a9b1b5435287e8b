"""The panel: what it shows (sections.py), what it does (presenter.py), both without Qt, for Slicer and the browser.

In Slicer: its widgets (widgets.py), wired to the presenter (panel.py), and the packages it needs (packages.py).
"""
