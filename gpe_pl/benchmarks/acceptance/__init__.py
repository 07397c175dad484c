"""Acceptance scenes of trained models: small scenes that a person would look at, run by solver and model side by side."""
