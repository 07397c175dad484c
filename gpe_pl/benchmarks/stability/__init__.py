"""Stress tests of trained simulators, each with a measurement, a limit, and a verdict."""
