"""Write reports of runs: settings, metrics, diagnoses and images, as one file.

`run_plots` loads runs, derives metrics and diagnoses, and draws them. `run_report` arranges tables,
plots and `frame_images` in one page, written with `html`, or tables alone as Markdown or LaTeX. A
page needs no network and runs no script.
"""
