"""Why a run is not optimal: its regret, split exactly over states, and the cause at each of them.

`split` divides the regret, `evidence` has what is known of a run, a module of `causes` tests one kind of cause
against it, and `verdict` puts them in order.
"""
