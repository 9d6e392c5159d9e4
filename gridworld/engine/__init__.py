"""Training as arrays: P runs of one algorithm at once, of which a single run is the case P = 1.

In a finite world a network needs to be run once per state, not once per sample. Whatever a loss makes of the
outputs f_θ(x_s), it depends on the parameters θ only through these S outputs:

    L(θ) = l(f_θ(x_1), ..., f_θ(x_S)),    ∂L/∂θ = Σ_s ∂l/∂f(x_s) · ∂f_θ(x_s)/∂θ

So one pass over the states gives the loss and the gradient of any number of samples, and while the parameters
stand still, the outputs are a table and acting is looking up.

All arrays have a leading axis P. A run has its own random generators and its own row, and no number of it
depends on the other rows. docs/reference/how-a-run-works.md says what is in each file.
"""
