"""The panel: its contents (sections.py) and its behaviour (presenter.py), without Qt, for Slicer and the browser.

Only for Slicer: the Qt widgets (widgets.py), their connection to the presenter (panel.py), and the installation of
packages (packages.py).
"""
