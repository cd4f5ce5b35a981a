"""The figures and the numbers of the paper of Fu et al., computed again."""
