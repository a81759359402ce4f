"""The bandwidth-demand cost function: a frame's demand and cycles without simulating it.

    scene | recording ──► workload ──► dispatch ──► walk ──► window ──► cycles
                                       tiles of     an L1's  reuse in   of each
                                       each SM      misses   L2, DRAM   launch

`model` holds the formulas' symbols, the coefficients and `predict`; `fit` finds the coefficients,
`file` keeps them, `measure` describes a recording, `terms` takes a prediction apart.
"""
