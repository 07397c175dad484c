"""Acceptance scenes of trained models: small scenes that a person would look at before using a model. Solver and model simulate each scene."""
