"""Studies of svwfs: how accurate and how fast it is, and next to other software.

They run from a checkout, `python -m studies NAME --out DIR`, and are no part of the wheel: they import everything, and
nothing imports them. Each study is a function that returns a table and a figure, listed in `studies.__main__`; the
packages that only `contestants` needs are in the dependency group `studies`.
"""

import svwfs  # noqa: F401 - finds app and the other packages, whatever the working folder has by their names
