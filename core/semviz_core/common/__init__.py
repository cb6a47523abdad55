"""General tools for every package, without domain knowledge.

`errors` defines the error that users read. `arrays` validates arrays where they enter the
program, and `files` writes files atomically. `store` is a place for files that are written once: a
folder, or an object store. `jit` compiles numerical loops and times them;
`linalg` solves small linear systems inside that compiled code. Modules here import nothing else
of semviz.
"""
