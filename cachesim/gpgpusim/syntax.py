"""Option files of GPGPU-Sim and network files of BookSim in, settings with file and line out.

An option file is a run of `-option value` pairs: `#` begins a comment, also inside quotes; a value
in quotes may go on over line breaks; an option given again takes its last value; `-config FILE`
reads another file at that place (facts sheet section 3.1). A BookSim file is a list of
`key = value;` with `//` comments.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

from traces.errors import InputError

#: The names that files of other years have for an option -> the name of today.
OLD_NAMES = {
    "-gmem_skip_L1D": "-gpgpu_gmem_skip_L1D",
    "-rop_latency": "-gpgpu_l2_rop_latency",
    "-perf_sim_memcpy": "-gpgpu_perf_sim_memcpy",
    "-memory_partition_indexing": "-gpgpu_memory_partition_indexing",
    "-l1_latency": "-gpgpu_l1_latency",
    "-l1_banks": "-gpgpu_l1_banks",
    "-smem_latency": "-gpgpu_smem_latency",
    "-adaptive_cache_config": "-gpgpu_adaptive_cache_config",
}
_TOKEN = re.compile(r'"[^"]*"|[^\s]+')
_OPTION = re.compile(r"-[A-Za-z_]")
_STATEMENT = re.compile(r"\s*(\w+)\s*=\s*([^;=]*);\s*")
_MAX_FILE_BYTES = 1 << 20


@dataclass(frozen=True)
class Setting:
    """One option's value as text, and where it was given.

    option: its name of today. file, line: the place; no file for GPGPU-Sim's own default.
    """

    option: str
    text: str
    file: Path | None = None
    line: int = 0

    def refuse(self, allowed: str) -> InputError:
        """An error that names file, line, option, value and what is allowed."""
        place = f"{self.file}:{self.line}" if self.file else "GPGPU-Sim's default"
        text = self.text if len(self.text) <= 80 else f"{self.text[:77]}..."
        return InputError(f"{place}: {self.option} {text!r}; {allowed}")


def read_option_files(files: Iterable[Path]) -> dict[str, Setting]:
    """Option -> its last setting over all files, in order of first mention.

    Raises:
        InputError: a file that cannot be read, that reads itself, or that is no option file.
    """
    settings: dict[str, Setting] = {}
    for file in files:
        for setting in _settings(file, ()):
            settings[setting.option] = setting
    return settings


def _settings(file: Path, readers: tuple[Path, ...]) -> Iterator[Setting]:
    """The settings of one file in order. `readers`: the files whose `-config` led here."""
    if file.resolve() in readers:
        raise InputError(f"{file}: a file cannot read itself by -config")
    option, values, line = "", [], 0
    for token, token_line in [*_tokens(file), ("-end", 0)]:
        quoted = token.startswith('"')
        if quoted or not _OPTION.match(token):
            if not option:
                raise InputError(
                    f"{file}:{token_line}: {_clip(token)} stands before any option; allowed is "
                    "-option value"
                )
            values.append(" ".join(token.strip('"').split()) if quoted else token)
            continue
        if option == "-config":
            other = Setting(option, " ".join(values), file, line)
            if len(values) != 1:
                raise other.refuse("allowed is the name of one file")
            yield from _settings(file.parent / values[0], (*readers, file.resolve()))
        elif option:
            yield Setting(OLD_NAMES.get(option, option), " ".join(values), file, line)
        option, values, line = token, [], token_line


def _tokens(file: Path) -> Iterator[tuple[str, int]]:
    """Words and quoted texts of a file without its comments, each with its line."""
    lines = [line.partition("#")[0] for line in read_text(file).splitlines()]
    text = "\n".join(lines)
    line, seen = 1, 0
    for match in _TOKEN.finditer(text):
        line, seen = line + text.count("\n", seen, match.start()), match.start()
        token = match[0]
        if token.startswith('"') and (token.count('"') != 2 or not token.endswith('"')):
            raise InputError(f"{file}:{line}: {_clip(token)}: the quote is not closed")
        yield token, line


def read_network_file(file: Path) -> dict[str, Setting]:
    """Key -> setting of a BookSim file.

    Raises:
        InputError: a file that cannot be read or is no list of `key = value;`.
    """
    text = re.sub(r"//[^\n]*", "", read_text(file))
    settings, end = {}, 0
    while text[end:].strip():
        line = 1 + text.count("\n", 0, end + len(text[end:]) - len(text[end:].lstrip()))
        match = _STATEMENT.match(text, end)
        if match is None:
            rest = text[end:].split("\n", 1)[0] or text[end:].strip()
            raise InputError(f"{file}:{line}: {_clip(rest.strip())}; allowed is key = value;")
        settings[match[1]] = Setting(match[1], " ".join(match[2].split()), file, line)
        end = match.end()
    return settings


def read_text(file: Path) -> str:
    """The text of a small file; comments may be in any encoding.

    Raises:
        InputError: it cannot be read, or is too large to be a configuration.
    """
    try:
        if file.stat().st_size > _MAX_FILE_BYTES:
            raise InputError(f"{file}: larger than {_MAX_FILE_BYTES} B: not a configuration")
        return file.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise InputError(f"{file}: {error.strerror}") from None


def _clip(text: str) -> str:
    return repr(text if len(text) <= 40 else f"{text[:37]}...")
