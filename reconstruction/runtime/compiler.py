"""Numba, which would read `.numba_config.yaml` of the working folder: such a file can run code and end the program.

All modules import Numba from here.
"""

import os
import sys
import warnings

os.environ["NUMBA_DISABLE_JIT"] = "0"  # kernels that are not compiled cannot run
_yaml = sys.modules.get("yaml")
sys.modules["yaml"] = None  # type: ignore[assignment] # Python's way to say that there is no such package
try:
    with warnings.catch_warnings(action="ignore"):  # that there is such a file
        import numba
        from numba import types
        from numba.core import config
        from numba.extending import intrinsic
finally:
    del sys.modules["yaml"]
    if _yaml is not None:
        sys.modules["yaml"] = _yaml
config._config_fname = os.devnull  # noqa: SLF001 - each compilation looks again

__all__ = ["intrinsic", "numba", "types"]
