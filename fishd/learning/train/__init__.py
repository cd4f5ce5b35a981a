"""Trainings: one run, its recorder and evaluations, or many seeds side by side."""
