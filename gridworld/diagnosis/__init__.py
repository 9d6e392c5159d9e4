"""Why a run is not optimal: its regret split over states, and the cause at each of them.

`evidence` has what is known of a run, and where its regret comes from. A cause is a function of the evidence;
`causes` has them in order, and `verdict` puts together what they find.
"""
