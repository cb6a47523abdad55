"""Compare localization methods on the same simulated problems.

`suites` names kinds of problems and methods. `runner` plans jobs, runs each method on each
problem and stores outcomes, and `report` presents them. `paper_table` adds the paper's printed
figures.
"""
