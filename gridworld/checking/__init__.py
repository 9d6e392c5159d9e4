"""Whether an implementation of an algorithm is right: small worlds with known answers that it trains on.

A probe is a row of `probes`: a world (`worlds`), what must hold after training (`expectations`), and what it
means where it does not. All exact numbers are from the solver. `settings` says how long and with which
arguments an algorithm trains, `training` trains it, `run` runs all probes and `table` shows the result.
"""
