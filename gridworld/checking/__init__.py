"""Whether an implementation of an algorithm is right: small worlds with known answers that it trains on.

A probe is a row of `probes`: a world (`worlds`), what must hold after training, and what it means where it
does not. All exact numbers are from the solver. `settings` says with which arguments and how long an
algorithm trains, `training` trains it, and `run` runs all probes.
"""
