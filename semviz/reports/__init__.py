"""Write reports of runs: settings, metrics, diagnoses and images, as one file.

`run_data` loads runs and derives metrics and diagnoses. `run_report` arranges tables,
`run_plots` and `frame_images` in one page, written with `html`, or tables alone as Markdown or
LaTeX. A page needs no network and runs no script.
"""
