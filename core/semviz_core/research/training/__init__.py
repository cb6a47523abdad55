"""Train the networks: samples, batches, the trainer, checkpoints, and the two shipped tasks.

`batch` defines what a training needs of a task, and pads samples to tensors. `simulated_samples`
makes samples (of `semviz_core.localization.correspondences`), and `trainer` loads batches, steps
the `learner` and writes a `checkpoint`. `verifier` and `detector` are tasks; `detector_images`,
`annotated_images` and `detector_crops` prepare the detector's data. An interrupted training resumes
bit-identically.
"""
