"""Accel-Sim's trace files: a Trace written as `kernelslist.g` and one `kernel-N.traceg` per launch,
and the memory instructions of such files read as a Trace.

`header` and `addresses` know the file format, `opcodes` the instruction set. `writer` goes from the
rows of a Trace (`accesses`: which addresses an instruction line carries; `code`: which registers
tie lines together) to files; `reader` goes from files (`lines`) back to rows (`warp`: which waits
the registers imply).
"""
