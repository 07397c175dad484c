"""Damage, hostility and interruption, done on purpose, and what comes of it."""
