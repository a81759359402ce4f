"""Machines as GPGPU-Sim and Accel-Sim describe them: option files in, presets out.

    option files ──► settings ──► options ──┬─► geometry ──┬─► fields with sources ──► TOML | Gpu
    BookSim's .icnt ────────────────────────┴─► timing ────┘

`syntax` reads the files, `options` has the table of what is known, `cache_string` the caches;
`geometry`, `sm`, `timing`, `network` and `dram` each make their tables of a preset.
"""

from cachesim.gpgpusim.options import Remark as Remark
from cachesim.gpgpusim.preset import Imported as Imported
from cachesim.gpgpusim.preset import group_remarks as group_remarks
from cachesim.gpgpusim.preset import import_config as import_config
from cachesim.gpgpusim.preset import leading_comments as leading_comments
