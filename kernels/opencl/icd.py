"""Which OpenCL drivers the loader sees: those of the machine and those of this environment.

An OpenCL loader finds drivers through `.icd` files, each one line naming a shared library. The
loader in the pyopencl wheel reads one folder (`OCL_ICD_VENDORS`, by default /etc/OpenCL/vendors)
and adds the PoCL wheel by itself. It misses Intel's CPU runtime installed from wheels, whose .icd
file names a path of the machine it was built on. So we write a folder that names everything and
point `OCL_ICD_VENDORS` at it, before the first OpenCL call, unless the user has set it.
"""

from __future__ import annotations

import atexit
import hashlib
import os
import shutil
import site
import sysconfig
import tempfile
from pathlib import Path

_FOLDER_PREFIX = "sss-cachesim-opencl-"
_INTEL_LIBRARY = "libintelocl.so"
#: In many containers the driver is there without its .icd file.
_NVIDIA_LIBRARY = "libnvidia-opencl.so.1"
_LIBRARY_FOLDERS = ("/usr/lib/x86_64-linux-gnu", "/usr/lib/aarch64-linux-gnu", "/usr/lib64")


def user_vendors() -> str | None:
    """The value of `OCL_ICD_VENDORS` if the user set it, None if it is unset or ours."""
    value = os.environ.get("OCL_ICD_VENDORS")
    return value if value and not Path(value).name.startswith(_FOLDER_PREFIX) else None


def use_all_drivers() -> None:
    """Make the drivers of the machine and of this Python environment visible to the OpenCL loader.

    Call before the first OpenCL call of the process. Does nothing where the user has set
    `OCL_ICD_VENDORS`; where no folder can be written, the loader's own default stays.
    """
    _use_writable_cache()
    if user_vendors() is not None:
        return
    folder = write_vendor_folder(driver_libraries(), _parents())
    if folder is not None:
        os.environ["OCL_ICD_VENDORS"] = str(folder)


def driver_libraries() -> dict[str, str]:
    """For every driver found: the .icd file to write, and the library it names."""
    system = Path(os.environ.get("OPENCL_VENDOR_PATH") or "/etc/OpenCL/vendors")
    found = {f"system-{name}": library for name, library in _read_folder(system).items()}
    for prefix in _prefixes():
        for name, library in _read_folder(prefix / "etc/OpenCL/vendors").items():
            if os.path.isabs(library) and os.path.exists(library):
                found[f"environment-{name}"] = library
        intel = prefix / "lib" / _INTEL_LIBRARY
        if intel.exists() and not any(_INTEL_LIBRARY in library for library in found.values()):
            found["environment-intel-cpu.icd"] = str(intel)
    if not any(_NVIDIA_LIBRARY in library for library in found.values()):
        if any(os.path.exists(f"{folder}/{_NVIDIA_LIBRARY}") for folder in _LIBRARY_FOLDERS):
            found["nvidia.icd"] = _NVIDIA_LIBRARY
    named: dict[str, str] = {}
    for name, library in found.items():
        named.setdefault(library, name)
    return {name: library for library, name in named.items()}


def write_vendor_folder(libraries: dict[str, str], parents: list[Path]) -> Path | None:
    """A folder holding exactly these .icd files, below the first parent that can be written.

    The folder's name is a hash of its content and it appears by one rename, so processes that
    start together agree and none sees half a folder. None where no parent can be written.
    """
    content = "".join(f"{name}\n{library}\n" for name, library in sorted(libraries.items()))
    name = _FOLDER_PREFIX + hashlib.sha256(content.encode()).hexdigest()[:16]
    for parent in parents:
        folder = parent / name
        if folder.is_dir() or _create_folder(folder, libraries):
            return folder
    return None


def _create_folder(folder: Path, libraries: dict[str, str]) -> bool:
    """Write the folder under another name, then rename it; False where that is not allowed."""
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        new = Path(tempfile.mkdtemp(prefix=".new-", dir=folder.parent))
    except OSError:
        return False
    try:
        for name, library in libraries.items():
            (new / name).write_text(library + "\n")
        new.chmod(0o755)
        new.rename(folder)
    except OSError:
        shutil.rmtree(new, ignore_errors=True)
    return folder.is_dir()


def _read_folder(folder: Path) -> dict[str, str]:
    """File name to first line of every readable .icd file of a folder, in order of name."""
    libraries = {}
    try:
        paths = sorted(folder.glob("*.icd"))
    except OSError:
        return {}
    for path in paths:
        try:
            lines = path.read_text().split("\n")
        except (OSError, UnicodeDecodeError):
            continue
        if lines[0].strip():
            libraries[path.name] = lines[0].strip()
    return libraries


def _prefixes() -> list[Path]:
    """Where wheels put their `lib` and `etc`: the environment, then the user's own site."""
    return [Path(sysconfig.get_path("data")), Path(site.getuserbase())]


def _cache_home() -> Path:
    return Path(os.environ.get("XDG_CACHE_HOME") or os.path.expanduser("~/.cache"))


def _parents() -> list[Path]:
    """Where the folder may live: in the environment, else in the user's cache."""
    return [Path(sysconfig.get_path("data")) / "share", _cache_home()]


def _use_writable_cache() -> None:
    """Where the user's cache cannot be written, use a temporary one: without, pyopencl fails."""
    home = _cache_home()
    try:
        home.mkdir(parents=True, exist_ok=True)
        writable = os.access(home, os.W_OK)
    except OSError:
        writable = False
    if not writable:
        temporary = tempfile.mkdtemp(prefix="sss-cachesim-cache-")
        atexit.register(shutil.rmtree, temporary, ignore_errors=True)
        os.environ["XDG_CACHE_HOME"] = temporary
