"""Train the networks: samples, batches, the trainer, checkpoints, and the two shipped tasks.

`task` defines what a training needs. `simulated_samples` makes samples (of
`semviz_core.localization.correspondences`), `batch` pads them to tensors, and `trainer` loads
batches, steps the `learner` and writes a `checkpoint`. `verifier` and `detector` are tasks;
`detector_images` and `detector_crops` prepare the detector's data. An interrupted training
resumes bit-identically.
"""
