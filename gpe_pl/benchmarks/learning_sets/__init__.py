"""The suite of other people's physics: published experiments, other engines, and public data sets beside solver and model."""
