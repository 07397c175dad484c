"""Checks that a model has to pass, for tests of this package and of others."""
