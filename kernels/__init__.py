"""The OpenCL side: scenes, G-buffers and the subsurface passes.

scenes ──► gbuffer ──► frame: pipeline of launches ──► record: a Trace
                        passes, a module and a `.cl` each, over maths, on opencl's device
                        reference: the same in NumPy; dense: the sum over every texel
"""

import os

# Before anything below imports pyopencl, which reads this once: its cache of binaries waits for
# minutes on a lock that a killed run left behind, and PoCL keeps a cache of its own.
os.environ.setdefault("PYOPENCL_NO_CACHE", "1")
