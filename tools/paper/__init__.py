"""Reproduction of the figures and numbers of the paper of Fu et al."""
