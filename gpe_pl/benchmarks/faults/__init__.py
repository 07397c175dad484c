"""Fault injection: deliberate damage, hostile input and interruption, and what follows from it."""
