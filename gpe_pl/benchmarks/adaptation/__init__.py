"""Models adapted with a few trajectories of another engine, beside the solver, the model as it is, and training from scratch."""
