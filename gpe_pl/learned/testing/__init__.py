"""Contract checks that every model has to pass, for the tests of this package and of packages with models of their own."""
