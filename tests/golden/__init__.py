"""The golden set: what semviz computes, stores and says, as it was before the code was moved about.

    cd tests && python -m golden check            all, 14 minutes: 10 of them G6 (Chromium)
    cd tests && python -m golden check G2 G3 G4 G9
    cd tests && python -m golden make G5          makes it the law: only where a change is meant

G1 localizations of every method and tracked drives; G2 runs of every version of the format; G3
label logs; G4 maps; G5 commands, their status, JSON and files; G6 addresses of both pages; G7
trainings that are stopped and gone on with; G8 detections; G9 exports and imports of all formats.

``expected`` holds one JSON file each: hashes, and some words that say where a difference lies.
``check`` prints one line each, and ends with status 1 where anything differs. Keys that begin with
"words: " are sentences for people; all else is data. Classes, modules and private names appear
nowhere: recorded values are hashed by the names of their fields.

G1, G4 to G8 are floating-point numbers to the last bit, so they hold on one machine with one set
of libraries: make them anew, from the old code, before comparing on another. ``test_golden`` checks
what is the same everywhere.

Left out, as it differs from one making to the next, or with the version:
- times: when something was made, how long it took (``canonical.MASKED_FIELDS``,
  ``commands.MASKED_KEYS``, ``training.LEFT_OUT``), and the time in operations of labels; their
  chain of hashes is built anew without it, by the rule of the format;
- versions: of semviz in texts and files, and ``made_by`` of maps, which spells out options as
  Python prints them, class names included;
- ids of imported labels, which are drawn anew: they are numbered in the order of their appearance;
- bytes of Parquet and .rrd files, which hold versions of libraries: their contents are compared;
- bytes of plots and report pages, of SQLite files and, in G5, of checkpoints: only that they are
  there.
"""
