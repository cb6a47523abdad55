"""Hold research code that only the research commands import.

`evaluation` sets benchmark problems and compares methods on them. `training` trains the
detector and the mode verifier. `paper` reproduces the paper's method. `pair_matcher` trains
the network of the method `correspondences`. Each package may import those named before it.
"""
