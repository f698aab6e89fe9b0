"""One phenomenon a file: fields, equation, bound, closed limit, reference, and the constants the kernels take.

A law takes arrays and scalars, and never sees a scene.
"""
