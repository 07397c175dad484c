"""Learned simulators of particles and meshes: the Graph-based Physics Engine and its baselines."""
