"""Command line: one file per command, collected in `main`.

The file `ctr_dynamics/cli/NAME.py` holds a function `NAME` with typer annotations; its docstring is the help.
It returns None or an exit code: 0 finished, 1 finished but some rows or steps failed or next to nothing was estimated. It raises InputError
for anything the user can mend. Only the file of the command that is run is imported.
"""
