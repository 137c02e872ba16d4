"""Published statements, figures and tables, each recomputed: one file per figure or statement.

Every module here has `rows()`, one dict each; `benchmarks.tables.reproduced` collects them for `oed reproduce`.
"""
