"""Whether an implementation of an algorithm is right: small worlds with known answers that it trains on.

A probe is a row of `probes`: a world, what must hold after training, and what it means where it
does not. All exact numbers are from the solver. `training` trains an algorithm on a probe's world, and `run`
runs all probes.
"""
