"""Where compiled loops are cached: a folder named by a hash of the sources.

numba recompiles a function when its own file changes, not when a function that it calls changes in
another file. After an update it would go on using old code, silently. A folder per state of the
sources cannot.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path

_ROOT = Path(__file__).resolve().parent.parent
#: The packages that hold compiled loops.
_PACKAGES = ("traces", "cachesim")


def source_hash(root: Path) -> str:
    """16 hex digits over the names and contents of the packages' Python files, nested ones too."""
    digest = hashlib.sha256()
    for package in _PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            digest.update(f"{name}\0".encode() + path.read_bytes())
    return digest.hexdigest()[:16]


def use_cache_of_sources() -> None:
    """Point numba at the folder of these sources, inside the one that the user chose if so.

    Has an effect before numba is imported. Where the folder cannot be written, numba falls back on
    its own.
    """
    name = source_hash(_ROOT)
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    if chosen and Path(chosen).name == name:
        return  # A process that one of ours started.
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    folder = Path(chosen) if chosen else base / "sss-cachesim"
    os.environ["NUMBA_CACHE_DIR"] = str(folder / name)
