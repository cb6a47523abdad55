"""Store labels durably in one SQLite file: state, operation log and backups.

`operations` are the hash-chained entries of the log. `database` opens the file and creates its
tables; `tables` reads and writes rows. `label_file` keeps the newest state in memory; `store`
applies, undoes and redoes edits on it. `backup` checks, copies, restores and exports the file.
"""
