"""Fault injection: damages files, feeds hostile input and interrupts commands, and records how they react."""
