"""What is known of the real cards at each level, for `cachesim microbench` to stand beside.

Bandwidths are in bytes per core cycle of one SM (l1), of one shader array (gl1), of the whole GPU
below; those of the memory in GB/s. A peak is what a maker states or a width implies, and streams on
silicon stay some 5 to 15 % below it.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """A number, and where it is from. is_peak: not attained but stated."""

    value: float
    source: str
    is_peak: bool = False


_BENCH = "gpu-benches, RX 6900 XT"
_TITAN_V = "90 % of peak, as Accel-Sim's tuner found on a TITAN V"
_WHITEPAPER = "AMD's RDNA whitepaper"
_BOARD = "the card's specification"
_PASCAL = "the Accel-Sim paper, Table IV"
_SJFENG = "sjfeng, RTX 2070"
_GH200 = "gpu-benches, GH200"

#: (preset, level) -> load-to-use latency in core cycles.
LATENCY: dict[tuple[str, str], Figure] = {
    ("rx-6900-xt", "l1"): Figure(73, _BENCH),
    ("rx-6900-xt", "gl1"): Figure(123, _BENCH),
    ("rx-6900-xt", "l2"): Figure(220, _BENCH),
    ("rx-6900-xt", "llc"): Figure(415, f"{_BENCH}: 407 to 423"),
    ("titan-x-pascal", "l1"): Figure(80, _PASCAL),
    ("titan-x-pascal", "l2"): Figure(238, _PASCAL),
    ("quadro-p4000", "l1"): Figure(80, _PASCAL),
    ("quadro-p4000", "l2"): Figure(216, "Jia et al., P4"),
    ("rtx-2060", "l1"): Figure(32, _SJFENG),
    ("rtx-2060", "l2"): Figure(236, _SJFENG),
    ("rtx-2060", "dram"): Figure(472, f"{_SJFENG}, a TLB miss in it"),
    ("rtx-2080-ti", "l1"): Figure(32, _SJFENG),
    ("rtx-2080-ti", "l2"): Figure(236, _SJFENG),
    ("rtx-2080-ti", "dram"): Figure(472, f"{_SJFENG}, a TLB miss in it"),
    ("h100-sxm", "l1"): Figure(33, f"{_GH200}: 32 to 34"),
    ("h100-sxm", "l2"): Figure(280, f"{_GH200}, near half"),
    ("h100-sxm", "dram"): Figure(680, f"{_GH200}: 680 to 689"),
    ("h200", "l1"): Figure(33, f"{_GH200}: 32 to 34"),
    ("h200", "l2"): Figure(280, f"{_GH200}, near half"),
    ("h200", "dram"): Figure(680, f"{_GH200}: 680 to 689"),
}
#: (preset, level) -> bandwidth, in the units above.
BANDWIDTH: dict[tuple[str, str], Figure] = {
    ("rx-6900-xt", "l1"): Figure(128, f"{_BENCH}, unit stride"),
    ("rx-6900-xt", "gl1"): Figure(256, _WHITEPAPER, True),
    ("rx-6900-xt", "l2"): Figure(1810, f"{_BENCH}: 4.65 TB/s"),
    ("rx-6900-xt", "llc"): Figure(968, f"{_BENCH}: 1.93 to 1.97 TB/s"),
    ("rx-6900-xt", "dram"): Figure(475, f"{_BENCH}: reads 450 to 500 GB/s"),
    ("rx-5700-xt", "l1"): Figure(128, _WHITEPAPER, True),
    ("rx-5700-xt", "gl1"): Figure(256, _WHITEPAPER, True),
    ("rx-5700-xt", "l2"): Figure(1024, _WHITEPAPER, True),
    ("rx-5700-xt", "dram"): Figure(448, _BOARD, True),
    ("titan-x-pascal", "l1"): Figure(64, _PASCAL, True),
    ("titan-x-pascal", "l2"): Figure(691, _TITAN_V),
    ("titan-x-pascal", "dram"): Figure(480, _BOARD, True),
    ("quadro-p4000", "l1"): Figure(64, _PASCAL, True),
    ("quadro-p4000", "l2"): Figure(461, _TITAN_V),
    ("quadro-p4000", "dram"): Figure(243, _BOARD, True),
    ("rtx-2060", "l1"): Figure(64, "Jia et al., T4", True),
    ("rtx-2060", "l2"): Figure(691, _TITAN_V),
    ("rtx-2060", "dram"): Figure(336, _BOARD, True),
    ("rtx-2080-ti", "l1"): Figure(64, "Jia et al., T4", True),
    ("rtx-2080-ti", "l2"): Figure(1267, _TITAN_V),
    ("rtx-2080-ti", "dram"): Figure(616, _BOARD, True),
    ("h100-sxm", "l1"): Figure(127, "gpu-benches: 126 to 128"),
    ("h100-sxm", "l2"): Figure(5016, f"{_GH200}: 37 to 39 B per SM"),
    ("h100-sxm", "dram"): Figure(3350, _BOARD, True),
    ("h200", "l1"): Figure(127, "gpu-benches: 126 to 128"),
    ("h200", "l2"): Figure(5016, f"{_GH200}: 37 to 39 B per SM"),
    ("h200", "dram"): Figure(4800, _BOARD, True),
}
