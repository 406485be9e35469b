"""Accuracy against known poses. Truth stays here: no estimator's signature can take it."""
