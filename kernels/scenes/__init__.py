"""Where G-buffers come from: the procedural head, formulas, meshes and captures; cameras, lights
and what moves them. `kernels.scene` is the way in.
"""
