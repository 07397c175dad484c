"""Stress tests of trained simulators: what is measured, against which limit, and whether it holds."""
