"""Read and write recorded runs, and evaluate them: diagnosis, metrics, comparison.

`run` defines a run, and `codec`, `writer` and `reader` its .rrd file, whose messages `rrd_file`
reads; `columns`, `rerun_scene` and `rerun_plots` add what rerun itself displays, and `images` the
image files. `frame_table` sums up the frames of a run, so that `stored_run` opens a long one
without reading them. On a loaded run,
`diagnosis` explains frames, `metrics` measures them, and `comparison` compares two runs, with
`differences` of map and setup and `gates` as conditions.
"""
