"""Matplotlib, which would read `matplotlibrc` of the working folder: such a file can run LaTeX and end the program.

Each module that imports Matplotlib imports this one first.
"""

import os
from unittest.mock import patch

_exists = os.path.exists

with patch("os.path.exists", lambda path: path != "matplotlibrc" and _exists(path)):
    from matplotlib.figure import Figure

__all__ = ["Figure"]
