"""What checks the model from outside: forms written independently of it, and figures of others.

- `lagrangian`: the same mechanics, dense and by automatic differentiation; classical Runge-Kutta.
- `slider_crank`: a public benchmark with a flexible rod, as one leg of the machine.
- `tables`: the paper's machine in an independent finite-element multibody code.

`studies.verify` puts them beside the model on the user's machine.
"""
