"""Mechanisms: one folder each, `contract` says what is in it."""
