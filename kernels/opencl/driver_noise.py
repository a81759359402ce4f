"""What OpenCL drivers print and say when they fail: kept off the terminal, cut to one line."""

from __future__ import annotations

import contextlib
import os
import sys
import tempfile
from collections.abc import Iterator

_MAX_REASON_CHARACTERS = 160


@contextlib.contextmanager
def noise_kept(lines: list[str] | None = None) -> Iterator[None]:
    """Keep what C code prints on stdout and stderr from the terminal while the block runs.

    Args:
        lines: what was printed is appended here, by line.
    """
    sys.stdout.flush()
    sys.stderr.flush()
    with contextlib.ExitStack() as stack:
        sink = stack.enter_context(tempfile.TemporaryFile())
        for descriptor in (1, 2):
            # A closed descriptor shows nothing, so there is nothing to keep.
            with contextlib.suppress(OSError):
                copy = os.dup(descriptor)
                stack.callback(os.close, copy)
                stack.callback(os.dup2, copy, descriptor)
                os.dup2(sink.fileno(), descriptor)
        try:
            yield
        finally:
            if lines is not None:
                sink.seek(0)
                lines += sink.read().decode(errors="replace").splitlines()


def short_reason(*texts: str) -> str:
    """The line that says most: the first with "error:", else the last that is not dressing."""
    lines = [line.strip() for text in texts for line in text.splitlines() if line.strip()]
    dressing = ("(options:", "(source saved", "Build on <")
    lines = [line for line in lines if not line.startswith(dressing)] or ["no reason given"]
    errors = [line for line in lines if "error:" in line.lower()]
    return (errors or lines[-1:])[0][:_MAX_REASON_CHARACTERS]
