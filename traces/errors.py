"""The error of bad user input: one line naming file, field, value and what is allowed."""

import difflib
from collections.abc import Iterable


class InputError(ValueError):
    """Bad input from a user. The command line prints it as one line and exits with code 2."""


def unknown(what: str, name: str, known: Iterable[str], where: str = "") -> InputError:
    """An `InputError` for an unknown name, with the nearest match and every allowed one."""
    known = sorted(known)
    begun = [candidate for candidate in known if name and candidate.startswith(name)]
    nearest = begun[:1] or difflib.get_close_matches(name, known, n=1, cutoff=0.5)
    hint = f"did you mean {nearest[0]!r}? " if nearest else ""
    place = f"{where}: " if where else ""
    return InputError(f"{place}unknown {what} {name!r}; {hint}choose from {', '.join(known)}")


class WorkError(RuntimeError):
    """A failure while working: no space, no device. The command line prints it as one line and
    exits with code 1.
    """
