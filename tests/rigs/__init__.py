"""Shared rigs, replacements of parts, and processes of the tests."""
