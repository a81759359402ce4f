"""How many warp instructions each pass issues between its accesses, counted from machine code.

`python -m kernels.instruction_counts.count` compiles the kernels that make the picture, one lane
per work-item, and writes `data/*.json`, two files per instruction set: Pascal (sm_61), Turing
(sm_75), Hopper (sm_90), Navi 10 (gfx1010) and Navi 21 (gfx1030). The recorder reads those; it needs
no compiler. Each file names its compilers and the hash of the kernels' text, and a test fails where
that text has changed since.

- `sm_61` and its like: the text that runs here, with our own polynomials, correctly rounded
  quotients and contraction off. What a GPU would take to compute the very same bits.
- `sm_61-native` and its like, the default: the same passes as a shader has them. Logarithms,
  exponentials, sines and cosines are the special function units' (native.cl for polynomial.cl),
  quotients and roots are approximate, products and sums fuse. On sm_61 a sample is 186 warp
  instructions then, and 347 exact.

    kernels' text -> clang + libclc -> ptxas -> nvdisasm -> instructions    compile, nvidia
                                  `-> assembly text      -> instructions    compile, amd
    instructions -> blocks -> the way of a warp, buffers of its accesses    flow
                 -> counts and waits between the accesses                   segments
                 -> a file per instruction set                              count, data
    counts -> the arithmetic of the trace's instructions                    assign

What is counted, and what not:

- Kinds: "fp32", "int", "sfu" (transcendentals, and what runs at a quarter of the rate or below:
  conversions and double precision on NVIDIA, 32-bit products on RDNA), "control" (branches,
  reconvergence, special registers, loads of constants, and RDNA's scalar unit). No double precision
  occurs. Memory instructions are the trace's own accesses.
- A warp in which something scatters and one in which nothing does take different ways, see `flow`;
  per sample is the body of the sample loop, found as the only cycle of blocks. A slow path of a
  division or root is never taken.
- An access of the trace is one fetch of a texel. Where the code fetches it in parts, it stands at
  the first. The further parts, and the loads of tables (tiles, lanes, counts, level ratios), are
  not charged, nor is a wait for them. The kernels read buffers: finding the address and widening
  the half floats count, which a texture unit would do itself, and so does the bilinear filter of
  the pre-filter pass.
- The n-th access of the machine code between two branches of the way is taken for the n-th of the
  trace: the compiler may exchange neighbours, such as the planes of a sample.
- Waits are those of the machine code: NVIDIA's barriers, RDNA's `s_waitcnt`. See `segments`.
- The recorder traces the reads of the estimate kernel as the sampling pass's; its instructions
  stand there too, between the accesses before the loop.
- Registers and shared memory are what the compiler reports; for RDNA the vector registers.
- libclc converts half floats in integers; vendors' compilers do not, and neither does this count.
"""
