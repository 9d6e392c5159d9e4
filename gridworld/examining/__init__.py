"""Whether an environment is right: what keeps an agent from learning in it.

`examine` makes the page of what `sampling` saw and `symptoms` and `hidden` found in it.
"""
