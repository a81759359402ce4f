"""The memory-system simulator: traces in, counters of every level out."""

from cachesim import presets as presets
from cachesim.bound import Bound as Bound
from cachesim.bound import belady as belady
from cachesim.config import Gpu as Gpu
from cachesim.report import Report as Report
from cachesim.simulate import simulate as simulate
from cachesim.simulate import simulate_all as simulate_all
from cachesim.sweep import sweep as sweep
