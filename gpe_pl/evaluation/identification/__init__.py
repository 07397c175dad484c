"""Identification: observed motion in, material parameters out, with intervals."""
