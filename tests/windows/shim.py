"""DLLs for what Wine 10 lacks, made with MinGW: functions of complex numbers, and ICU's converters for Qt.

Wine's ucrtbase has no functions of complex numbers, which NumPy, SciPy, h5py and Numba import from
`api-ms-win-crt-math-l1-1-0.dll`. Wine answers that name itself, so `MATH`, of equal length, replaces it in their files:
it has these functions, and forwards the others. Qt 6.8 imports `icuuc.dll`, whose functions may fail politely.
pyserial must take a time-out of Wine for one. Wine's clock is too fine for Dask, which refines that of Windows for
Pythons before 3.13, and waits for ever until it stands still for some looks.
"""

from __future__ import annotations

import subprocess
from collections.abc import Iterator
from pathlib import Path

import pefile

SYSTEMS, MATH, ICU = "api-ms-win-crt-math-l1-1-0", "wim-ms-win-crt-math-l1-1-0", "icuuc"
COMPILER = "x86_64-w64-mingw32-gcc"
_COMPLEX = ["catan", "ccos", "ccosh", "cexp", "clog", "csin", "csinh", "csqrt", "ctan", "ctanh"]
_BUILDERS = {"_Cbuild", "_FCbuild", "_LCbuild"}
_REPLACED = _BUILDERS | {
    f"{name}{kind}" for name in (*_COMPLEX, "cabs", "carg", "cimag", "cpow", "creal") for kind in ("", "f", "l")
}
_CONVERTERS = (
    "UCNV_FROM_U_CALLBACK_SUBSTITUTE UCNV_TO_U_CALLBACK_SUBSTITUTE ucnv_cbFromUWriteUChars ucnv_cbToUWriteUChars"
    " ucnv_close ucnv_countAvailable ucnv_fromUCountPending ucnv_fromUnicode ucnv_getFromUCallBack ucnv_getMaxCharSize"
    " ucnv_getToUCallBack ucnv_reset ucnv_setFromUCallBack ucnv_setToUCallBack ucnv_toUCountPending ucnv_toUnicode"
)

# Where Windows reads nothing in time, Wine reports the error ERROR_TIMEOUT.
_NO_INPUT = (
    "if win32.GetLastError() != win32.ERROR_OPERATION_ABORTED:",
    "if win32.GetLastError() not in (win32.ERROR_OPERATION_ABORTED, 1460):",
)
_FINE_CLOCK = "if WINDOWS and sys.version_info < (3, 13):", "if False:"

# Microsoft's compiler passes a complex number as this structure. Its `long double` is a `double`.
_BEGINNING = """
#include <complex.h>
#include <math.h>

typedef struct { double real, imaginary; } Double;
typedef struct { float real, imaginary; } Float;

static double _Complex number(Double given) {
    double _Complex made;
    ((double *)&made)[0] = given.real;
    ((double *)&made)[1] = given.imaginary;
    return made;
}
static double _Complex wide(Float given) { return number((Double){given.real, given.imaginary}); }
static Double pair(double _Complex given) { return (Double){creal(given), cimag(given)}; }
static Float narrow(double _Complex given) { return (Float){(float)creal(given), (float)cimag(given)}; }

Float my__FCbuild(float real, float imaginary) { return (Float){real, imaginary}; }
"""
_OF_DOUBLE = """
double my_creal@(Double z) { return z.real; }
double my_cimag@(Double z) { return z.imaginary; }
double my_cabs@(Double z) { return hypot(z.real, z.imaginary); }
double my_carg@(Double z) { return atan2(z.imaginary, z.real); }
Double my_cpow@(Double base, Double power) { return pair(cpow(number(base), number(power))); }
"""
_OF_FLOAT = """
float my_crealf(Float z) { return z.real; }
float my_cimagf(Float z) { return z.imaginary; }
float my_cabsf(Float z) { return (float)hypot(z.real, z.imaginary); }
float my_cargf(Float z) { return (float)atan2(z.imaginary, z.real); }
Float my_cpowf(Float base, Float power) { return narrow(cpow(wide(base), wide(power))); }
"""
_ICU_SOURCE = """
void *ucnv_open(const char *name, int *error) { *error = 1; return 0; }
const char *ucnv_getName(void *converter, int *error) { return ""; }
const char *ucnv_getAvailableName(int index) { return 0; }
const char *ucnv_getStandardName(const char *name, const char *standard, int *error) { *error = 1; return 0; }
"""


def mend(site_packages: Path, folder: Path, root: Path) -> int:
    """Make the DLLs in `folder`, compiled in the Debian of `root`, let packages use them; return how many files do."""
    imported, users = set[str](), list[Path]()
    for path in sorted(site_packages.rglob("*")):
        if path.suffix.lower() in {".pyd", ".dll"} and path.is_file():
            names = set(_imported(path))
            imported |= names
            if names & _REPLACED:
                users.append(path)
    _compile(root, folder, MATH, _math_source(), {name: _math_export(name) for name in sorted(imported)})
    failing = _CONVERTERS.split()
    icu = [*failing, "ucnv_open", "ucnv_getName", "ucnv_getAvailableName", "ucnv_getStandardName"]
    icu_source = _ICU_SOURCE + "".join(f"int {name}(void) {{ return 0; }}\n" for name in failing)
    _compile(root, folder, ICU, icu_source, {name: name for name in icu})
    for path, old, new in [
        (site_packages / "serial" / "serialwin32.py", *_NO_INPUT),
        (site_packages / "distributed" / "metrics.py", *_FINE_CLOCK),
        *((path, f"{SYSTEMS}.dll", f"{MATH}.dll") for path in users),
    ]:
        changed = path.read_bytes().replace(old.encode(), new.encode())
        assert new.encode() in changed, path
        path.unlink()  # it may be a link into the cache of uv
        path.write_bytes(changed)
    return len(users)


def _imported(path: Path) -> Iterator[str]:
    """Names that a DLL imports from the system's functions of numbers."""
    try:
        with pefile.PE(str(path), fast_load=True) as image:
            image.parse_data_directories([pefile.DIRECTORY_ENTRY["IMAGE_DIRECTORY_ENTRY_IMPORT"]])
            for library in getattr(image, "DIRECTORY_ENTRY_IMPORT", ()):
                if library.dll.decode().lower().removesuffix(".dll") in {SYSTEMS, MATH}:
                    yield from (entry.name.decode() for entry in library.imports if entry.name)
    except pefile.PEFormatError:  # some packages bring DLLs of other systems
        return


def _math_source() -> str:
    parts = [_BEGINNING, _OF_FLOAT]
    parts += [f"Float my_{name}f(Float z) {{ return narrow({name}(wide(z))); }}\n" for name in _COMPLEX]
    for kind, builder in (("", "_Cbuild"), ("l", "_LCbuild")):
        parts.append(f"Double my_{builder}(double real, double imaginary) {{ return (Double){{real, imaginary}}; }}\n")
        parts.append(_OF_DOUBLE.replace("@", kind))
        parts += [f"Double my_{name}{kind}(Double z) {{ return pair({name}(number(z))); }}\n" for name in _COMPLEX]
    return "".join(parts)


def _math_export(name: str) -> str:
    return f"my_{name}" if name in _REPLACED else f"ucrtbase.{name}"


def _compile(root: Path, folder: Path, name: str, source: str, exports: dict[str, str]) -> None:
    """Make a DLL of a source by the compiler of a Debian in a folder."""
    work = root / "tmp"
    (work / f"{name}.c").write_text(source)
    lines = [f"  {outside} = {inside}" if outside != inside else f"  {outside}" for outside, inside in exports.items()]
    (work / f"{name}.def").write_text("\n".join([f"LIBRARY {name}.dll", "EXPORTS", *lines, ""]))
    command = ["chroot", str(root), COMPILER, "-shared", "-O2", "-w", "-s", "-static-libgcc"]
    command += ["-o", f"tmp/{name}.dll", f"tmp/{name}.c", f"tmp/{name}.def"]  # chroot begins in its root
    subprocess.run(command, check=True)  # noqa: S603 - made by us
    (folder / f"{name}.dll").write_bytes((work / f"{name}.dll").read_bytes())
