"""Which folder compiled loops are cached in."""

import os
import re
import subprocess
import sys
from pathlib import Path

from traces.compiled_code import source_hash

ROOT = Path(__file__).resolve().parent.parent


def packages(root: Path) -> Path:
    for name in ("traces", "cachesim", "kernels"):
        (root / name).mkdir(parents=True)
        (root / name / "a.py").write_text(f"{name} = 1\n")
    return root


def test_any_change_of_any_source_changes_the_folder(tmp_path: Path) -> None:
    root = packages(tmp_path)
    before = source_hash(root)
    assert source_hash(root) == before
    (root / "cachesim" / "a.py").write_text("cachesim = 2\n")
    changed = source_hash(root)
    (root / "traces" / "a.py").rename(root / "traces" / "b.py")
    assert len({before, changed, source_hash(root)}) == 3


def test_other_sources_do_not_change_the_folder_and_hold_no_compiled_loops(tmp_path: Path) -> None:
    root = packages(tmp_path)
    before = source_hash(root)
    (root / "kernels" / "a.py").write_text("kernels = 2\n")
    assert source_hash(root) == before
    sources = [path for room in ("kernels", "experiments") for path in (ROOT / room).rglob("*.py")]
    assert sources
    for path in sources:
        assert not re.search(r"\bn?jit\b|\bvectorize\b", path.read_text()), path


def cache_folder(environment: dict[str, str]) -> str:
    code = "import cachesim, numba; print(numba.config.CACHE_DIR)"
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_numba_caches_under_the_hash_in_the_users_folder_if_one_is_chosen(tmp_path: Path) -> None:
    environment = {k: v for k, v in os.environ.items() if k != "NUMBA_CACHE_DIR"}
    environment["XDG_CACHE_HOME"] = str(tmp_path)
    expected = tmp_path / "sss-cachesim" / source_hash(ROOT)
    assert cache_folder(environment) == str(expected)
    chosen = Path("/chosen") / source_hash(ROOT)
    assert cache_folder(environment | {"NUMBA_CACHE_DIR": "/chosen"}) == str(chosen)
    # A process that was started with the folder keeps it.
    assert cache_folder(environment | {"NUMBA_CACHE_DIR": str(chosen)}) == str(chosen)
