"""Scenes of your own: bodies and obstacles in a few lines, rolled out by a model and a solver."""
