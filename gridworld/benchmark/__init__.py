"""Speed beside named peers, in turn in the same run: a machine's drift hits both sides of a ratio alike.

A module per kind of measurement, each with `rows(scale)`. Absolute numbers belong to one machine on one
day; the ratios are what to quote.
"""
