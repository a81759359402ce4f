"""The passes: a module each, with the accesses that are traced, the kernel's arguments and a NumPy
reference, and its `.cl` beside it; and what several of them share.
"""
