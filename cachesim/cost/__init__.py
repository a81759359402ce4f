"""The bandwidth-demand cost function: a frame's demand and cycles without simulating it.

    scene | recording ──► workload ──► footprint ──► tiles ──► window ──► cycles
                                       a warp's      misses of  reuse in   of each
                                       sectors       the L1     L2, DRAM   launch

`model` holds the formulas' symbols, the coefficients and `predict`; `fit` finds the coefficients,
`file` keeps them, `measure` describes a recording, `terms` takes a prediction apart.
"""
